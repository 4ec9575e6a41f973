"""Readings of total stations, theodolites, levels and tapes: their equations, parameters and rows."""
