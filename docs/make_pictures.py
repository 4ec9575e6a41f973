"""Pictures of these pages, taken from reports with Chromium.

Run: python -m docs.make_pictures PAGE.html SECTION OUT.png [TALLEST]
SECTION is the anchor of a section, or "head" for everything above the second one. Needs Chromium or Chrome.
"""

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from docs.palette import write_palette_png

WIDTH, HEIGHT, MARGIN = 1000, 3200, 12
BROWSERS = ("chromium", "google-chrome", "chromium-browser")


def main(page: Path, section: str, out: Path, tallest: int = 900) -> None:
    """Write the section as a picture that is at most ``tallest`` pixels high."""
    css = "" if section == "head" else f"main>*{{display:none!important}}#{section}{{display:block!important}}"
    text = page.read_text(encoding="utf-8")
    if section != "head" and not re.search(rf'id="{section}"', text):
        sys.exit(f"{page}: there is no section {section!r}")
    with tempfile.TemporaryDirectory() as folder:
        shown, shot = Path(folder, "page.html"), Path(folder, "shot.png")
        shown.write_text(text.replace("</head>", f"<style>{css}</style></head>"), encoding="utf-8")
        browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
        if browser is None:
            sys.exit(f"no browser; install one of {', '.join(BROWSERS)}")
        subprocess.run(
            [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run",
             "--disable-background-networking", "--disable-component-update", "--disable-sync",
             f"--user-data-dir={folder}/profile", f"--window-size={WIDTH},{HEIGHT}", f"--screenshot={shot}",
             shown.as_uri()], check=True, capture_output=True, timeout=120,
        )  # fmt: skip
        image = cv2.imread(str(shot))
    inked = np.argwhere((image < 250).any(axis=2))
    (top, left), (bottom, right) = inked.min(axis=0), inked.max(axis=0)
    box = image[max(top - MARGIN, 0) : min(bottom + MARGIN, top + tallest), max(left - MARGIN, 0) : right + MARGIN]
    write_palette_png(out, cv2.imencode(".png", box)[1].tobytes())


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]), *(int(n) for n in sys.argv[4:5]))
