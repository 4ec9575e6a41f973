"""Eyes of one station: cameras without a common view, trackers, marker blocks.

Where each sits, from what each of them saw (images, poses, trajectories), and the pairs between them. Networks of such
pairs are in the room around this one.
"""
