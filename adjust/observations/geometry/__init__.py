"""Observations of lines, surfaces and differences.

Alignments, positions on surfaces, levels, coordinate differences.
"""
