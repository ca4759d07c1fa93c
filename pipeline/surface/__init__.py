"""The trench that was dug against the trench that was designed, and against the total station.

All coordinates in this room are grid metres; files come in the grid unit and are converted where they are read.
Modules: ``alignment`` ``clothoid`` (station and offset); ``landxml`` ``dxf`` ``profile_csv`` ``shots`` (what others
hand us); ``plan_geometry`` ``long_profile`` ``pipe_run`` (files into geometry); ``design``; ``sweep`` ``lowest_pass``
``as_built`` (the cutting edge as a surface); ``decision`` (PASS, FAIL, CANNOT TELL); ``checks`` (the total station);
``distance_bound`` ``nearest`` ``approach`` ``utilities`` (buried lines); ``table`` (columns of the artefacts).
"""
