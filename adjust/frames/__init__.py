"""Which unknowns a survey has.

Under which key, how a frame is reached from the world through them, and their current values as arrays. No
observation is known here.
"""
