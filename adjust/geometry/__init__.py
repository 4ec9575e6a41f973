"""Observations of geometry: levels, parallel axes, laser spots, surfaces, coordinate differences."""
