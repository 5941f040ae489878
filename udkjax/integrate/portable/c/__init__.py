"""A scene out of Python: a folder of C99 that runs it.

scene.py     the functions of a scene in C, on the units of `native.c`
folder.py    the folder: a header, numbers, a file for each function, and a program that runs the scene
"""

from udkjax.integrate.portable.c.folder import ExportedCode, export_c

__all__ = ["ExportedCode", "export_c"]
