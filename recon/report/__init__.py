"""Self-contained HTML pages and their figures.

Draws and writes results; computes none.
"""
