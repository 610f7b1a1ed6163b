"""Files in and out: instruments' formats to recordings, pictures and summaries to folders.

Contains no estimation and no imaging.
"""
