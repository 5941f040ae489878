"""A scene as an FMU, by FMI 3.0, for co-simulation and model exchange.

variables.py     the variables of an FMU: names, units, places
description.py   modelDescription.xml
package.py       the FMU: sources, binaries and description
compilers.py     C compilers for this platform and others
sources/         FMI's functions in C, the same for all scenes
"""

from udkjax.integrate.portable.fmi.package import ExportedFMU, export_fmu

__all__ = ["ExportedFMU", "export_fmu"]
