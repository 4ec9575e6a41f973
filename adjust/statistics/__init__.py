"""Statistics of an adjusted survey: tests, reliability, variance components, outliers, precision, error budget."""
