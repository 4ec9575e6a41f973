"""Readings of total stations, theodolites and levels: observation equations, start values, statistics."""
