"""``python -m survey`` is the command ``labsurvey``."""

import sys

from survey.cli import main

sys.exit(main())
