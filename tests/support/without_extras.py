"""Python as it is where nht was installed without extras: what these bring cannot be imported."""

import sys
from importlib.machinery import PathFinder

EXTRAS = {
    "dm_control",
    "gymnasium_robotics",
    "h5py",
    "hydra",
    "imageio",
    "matplotlib",
    "minari",
    "omegaconf",
    "onnx",
    "onnxruntime",
    "onnxscript",
    "pandas",
    "PIL",
    "ray",
    "scipy",
    "tqdm",
    "viser",
    "wandb",
    "yaml",
}


def hide(names=frozenset(EXTRAS)):
    """Let the path of imports lack some packages."""

    class Rest(PathFinder):
        @classmethod
        def find_spec(cls, name, path=None, target=None):
            return None if name.split(".")[0] in names else PathFinder.find_spec(name, path, target)

    sys.meta_path[:] = [Rest if finder is PathFinder else finder for finder in sys.meta_path]
