"""Weights that contradict the residuals: sigmas of a group wrong by a factor, single sigmas far from all others'."""
