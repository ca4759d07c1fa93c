"""A site whose truth we know: an excavator digs a trench, two cameras and a sensor record it.

``specification`` says what a site is made of, ``cycle`` moves the machine, ``excavator`` gives its parts a
pose at any time and draws the errors that its files shall have, ``survey`` writes the files a surveyor would
hand over, ``scenery`` and ``renderer`` make the frames, ``recording`` the log, ``truth`` what really happened.

No other room imports this one, and nothing here uses detection: a convention that both got wrong in the same
way would never be found. What is shared is the foundation (``pipeline.geometry``), and for the pixels not even
that: the renderer carries a camera model of its own.
"""
