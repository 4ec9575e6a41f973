"""Table readings checked against images: swapped axes, signs, units, epochs, moved and mis-detected targets."""

from adjust.diagnosis.table.check import only_symptoms, probable_causes, sign_warnings
from adjust.diagnosis.table.unseen import unseen_readings

__all__ = ["only_symptoms", "probable_causes", "sign_warnings", "unseen_readings"]
