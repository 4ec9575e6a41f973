"""The compiled core: C++ without its library behind plain C functions, and their typed faces.

Here belongs what is evaluated once per image point, pixel, pose or clique: lenses, image points, bundles, reduced
poses, recursions over a Bayes tree, fits of corners and spots, minimal poses, rendering. What is called once a survey,
or can be said in batches by NumPy, SciPy or OpenCV, does not belong here. A module of Python for each header of C++.
"""
