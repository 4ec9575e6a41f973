"""Geometry of space without a survey.

Rotations and their forms, rigid motions and similarities, the plumb line, the motions of a whole network. Solutions
that need observations are in :mod:`adjust.start`.
"""
