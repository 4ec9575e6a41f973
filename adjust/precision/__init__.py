"""Covariances of a solved survey from the tree of its solution.

By the names of parameters, and in another datum (S-transformation). Tests of observations are in
:mod:`adjust.statistics`.
"""
