"""What is wrong with a survey that does not fit: hypotheses, each tried on the observations themselves.

A family (a function in a room of this one, listed in :mod:`adjust.diagnosis.families`) forms hypotheses from cheap
evidence, never by adjusting; :func:`adjust.diagnosis.diagnosis.diagnose` tries the likeliest of all families and ranks
them. Values in, values out: the lines of a project to edit, and the edits themselves, are the business of ``survey``.
"""
