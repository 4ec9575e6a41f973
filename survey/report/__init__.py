"""Reports of an adjustment: one self-contained HTML page, and a summary for the terminal. They print, nothing more.

Importing the package loads neither: words and colours are needed without them.
"""
