"""Relay networks: stations joined by measured relative rotations or poses, adjusted in two equivalent forms.

Loops with their misclosures, what a network of pairs can tell by counts, the form of conditions, networks that grow
while they are measured, and the eyes of one station. How stations and pairs are solved is :mod:`adjust.pose_network`.
"""
