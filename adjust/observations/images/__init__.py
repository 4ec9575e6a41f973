"""Image points.

Of known targets in condensed blocks, and of unknown points with points and poses reduced in the batch.
"""
