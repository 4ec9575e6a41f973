"""What is wrong with a survey that does not fit: hypotheses, each tried on the observations themselves."""
