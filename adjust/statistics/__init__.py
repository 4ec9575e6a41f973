"""Statistics of an adjusted survey: tests, reliability, variance components, outliers, precision, error budget.

What needs a solved survey, and the adjustment without its gross errors. Distributions and critical values, which need
none, are in :mod:`adjust.testing`; covariances by name in :mod:`adjust.precision`.
"""
