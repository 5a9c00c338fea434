"""Learned action interfaces: from low-dimensional actions, in a context, to the actuation of the motors.

Nothing is imported before it is asked for.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nht.actuation_lipschitz import actuation_certificate
    from nht.alignment import Aligned, align
    from nht.demos import Demos
    from nht.demos_folder import load_demos, save_demos
    from nht.export import export_map
    from nht.hdf5 import from_hdf5
    from nht.jacobian import JacobianPinv
    from nht.laser import CAE, LASER
    from nht.lipschitz import certificate, offset_certificate
    from nht.maps import NHT, SVD, ActionMap, Identity, LinearActionMap
    from nht.minari import from_minari
    from nht.minari_writing import to_minari
    from nht.residual import Residual
    from nht.scl import SCL
    from nht.storage import load_map, save_map
    from nht.train import MapTraining, projection_error, train_map
    from nht.train_together import train_maps

_NAMES = {
    "actuation_lipschitz": ("actuation_certificate",),
    "alignment": ("Aligned", "align"),
    "demos": ("Demos",),
    "demos_folder": ("load_demos", "save_demos"),
    "export": ("export_map",),
    "hdf5": ("from_hdf5",),
    "jacobian": ("JacobianPinv",),
    "laser": ("CAE", "LASER"),
    "lipschitz": ("certificate", "offset_certificate"),
    "maps": ("NHT", "SVD", "ActionMap", "Identity", "LinearActionMap"),
    "minari": ("from_minari",),
    "minari_writing": ("to_minari",),
    "residual": ("Residual",),
    "scl": ("SCL",),
    "storage": ("load_map", "save_map"),
    "train": ("MapTraining", "projection_error", "train_map"),
    "train_together": ("train_maps",),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [
    "CAE",
    "LASER",
    "NHT",
    "SCL",
    "SVD",
    "ActionMap",
    "Aligned",
    "Demos",
    "Identity",
    "JacobianPinv",
    "LinearActionMap",
    "MapTraining",
    "Residual",
    "actuation_certificate",
    "align",
    "certificate",
    "export_map",
    "from_hdf5",
    "from_minari",
    "load_demos",
    "load_map",
    "offset_certificate",
    "projection_error",
    "save_demos",
    "save_map",
    "to_minari",
    "train_map",
    "train_maps",
]

__version__ = version("nht")


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}.")
    found = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__
