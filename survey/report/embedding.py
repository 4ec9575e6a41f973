"""Data inside a page for its script, in a form that cannot end the script or become markup."""

import json
from typing import Any

from survey.report.markup import TURNING


def json_script(anchor: str, value: Any) -> str:
    """Plain values as a JSON block with an id."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    text = text.translate({sign: f"\\{shown}" for sign, shown in TURNING.items()})  # the script shows the escape
    return f'<script type="application/json" id="{anchor}">{text}</script>'
