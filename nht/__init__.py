"""Learned action interfaces: from low-dimensional actions, in a context, to the actuation of the motors."""

from importlib.metadata import version

from nht.actuation_lipschitz import actuation_certificate
from nht.align import Aligned, align
from nht.demos import Demos, load_demos, save_demos
from nht.export import export_map
from nht.hdf5 import from_hdf5
from nht.jacobian import JacobianPinv
from nht.laser import CAE, LASER
from nht.lipschitz import certificate, offset_certificate
from nht.maps import NHT, SVD, ActionMap, Identity, LinearActionMap
from nht.minari import from_minari, to_minari
from nht.residual import Residual
from nht.scl import SCL
from nht.storage import load_map, save_map
from nht.train import MapTraining, projection_error, train_map

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
]

__version__ = version("nht")
