"""Cameras, turntables and the capture session."""
