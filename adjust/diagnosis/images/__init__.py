"""Images that are not as the camera saw them: mirrored, turned. Changes from some epoch on begin in ``bodies``."""
