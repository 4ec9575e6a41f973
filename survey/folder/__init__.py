"""Files and folders, whatever is in them.

Text, arrays and JSON from anywhere, units that people write, locks, and changes that are on disk whole or not at all.
"""
