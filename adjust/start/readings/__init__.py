"""Start values of points and setups from readings alone.

In the plane, in space, tilted, and several setups at once.
"""
