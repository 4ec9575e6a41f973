"""Relay networks: stations joined by measured relative rotations or poses, adjusted in two equivalent forms.

Loops with their misclosures, what a network of pairs can tell by counts, the form of conditions, and the eyes of one
station. Networks of poses by stations are in :mod:`adjust.pose_network`.
"""
