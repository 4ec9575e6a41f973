"""The one graph.

Put together from a survey and start values, with its datum, what it leaves undetermined, and the one solver.
Covariances are in :mod:`adjust.precision`.
"""
