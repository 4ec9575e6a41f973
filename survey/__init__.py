"""The jobs around the adjustment: project folders, target detection, reports, the command ``labsurvey``."""
