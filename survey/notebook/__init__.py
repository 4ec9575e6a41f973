"""The Python interface for notebooks: the five steps, results as data frames, covariances and plots by name.

What it offers stands in :mod:`survey`; see docs/python.md.
"""
