"""Cameras and turntables: what they are to the session, and their drivers."""
