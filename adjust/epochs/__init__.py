"""Several epochs: adjusted together, compared by congruence, and what moved between them.

A single epoch is adjusted as every survey is; poses of a head epoch by epoch are in :mod:`adjust.navigation`.
"""
