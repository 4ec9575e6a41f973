"""What a survey is, as frozen values.

The owners of its unknowns, its observations, what an adjustment gives back, and the errors a user can mend. Nothing
here computes anything; the ground that every other room stands on.
"""
