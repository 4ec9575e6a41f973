"""What a page shows of a folder that is no project yet, and of one that a capture session fills.

Here belong a project's beginning, and what a session's files say. What a solution says is in the modules above.
"""
