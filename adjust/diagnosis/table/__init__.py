"""Table readings checked against images: swapped axes, signs, units, epochs, moved and mis-detected targets."""

from adjust.diagnosis.table.check import only_symptoms, probable_causes, sign_warnings

__all__ = ["only_symptoms", "probable_causes", "sign_warnings"]
