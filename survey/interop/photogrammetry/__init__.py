"""Files of photogrammetric bundle adjustments: surveys with their observations."""
