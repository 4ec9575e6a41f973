"""Finding boards, markers and LED beacons in images, each point with its covariance."""
