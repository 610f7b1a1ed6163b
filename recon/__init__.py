"""Reconstruction: from motion and intensity to a picture, its assessment, files, reports and the command line.

It uses all other packages. Estimators do not belong here (``estimation``), nor models of the instrument (``scanner``).
"""
