"""The job ``navigate``: what is navigated, the calibration it works with, and a pose for every epoch."""
