"""``python -m survey`` is the command ``labsurvey``."""

from survey.cli import program

program()
