"""The lens models by name.

Their parameters and start values, where each is valid, and one model in the parameters of another. Their mathematics
is in :mod:`adjust.native`; poses and points do not belong here.
"""
