"""Terms of the equations of a scene: masses, loads, constraints and their derivatives, element by element.

The other folders of `equations` take what they need from here; the layout of a scene's numbers (`scene_layout`) and the names of
arrays are common to all programs, so whoever changes them changes every program.
"""
