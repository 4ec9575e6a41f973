"""Gross errors of a whole survey: the search over all kinds of observations, and what a survey is without them."""
