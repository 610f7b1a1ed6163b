"""Imaging: from the motion and the detector's samples to a picture, its blur, and phases measured in it.

Works on arrays, motions and channels. It reads and writes no file and does not decide what a command does.
"""
