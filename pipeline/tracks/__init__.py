"""From the adjusted states to what leaves the house: poses and the cutting edge in the survey grid.

Modules: ``poses`` (the arithmetic), ``table`` (columns of the artefacts).
"""
