"""The public interface: every name that programs, notebooks and documentation use.

Import from here only; all other packages may change their inside. Names are imported when they are first used, so that
``import lissajous`` takes milliseconds. This package contains no algorithms, and no other package may import it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimation.estimators import register as register_estimators
    from lissajous.functions import (
        convert,
        diagnose,
        estimate,
        identify,
        load_device,
        predict,
        reconstruct,
    )
    from lissajous.planning import ScanDesign, blur_study, design
    from lissajous.simulation import Simulation, simulate
    from recon.imaging.blur import compare_with_scene, phase_bound
    from recon.imaging.gridding import map_samples
    from recon.imaging.picture import Grid, Picture
    from recon.io.readers import register as register_readers
    from recon.sequences.frames import ScanFrames, frames
    from scanner.device import Device
    from scanner.errors import BadInput
    from scanner.motion import Motion
    from scanner.recording import Recording
    from scanner.terms import catalogue
    from scanner.terms import register as register_effects

    __version__: str

__all__ = [
    "BadInput",
    "Device",
    "Grid",
    "Motion",
    "Picture",
    "Recording",
    "ScanDesign",
    "ScanFrames",
    "Simulation",
    "__version__",
    "blur_study",
    "catalogue",
    "compare_with_scene",
    "convert",
    "design",
    "diagnose",
    "estimate",
    "frames",
    "identify",
    "load_device",
    "map_samples",
    "phase_bound",
    "predict",
    "reconstruct",
    "register_effects",
    "register_estimators",
    "register_readers",
    "simulate",
]

_DEFINED_ELSEWHERE = {
    "Simulation": ("lissajous.simulation", "Simulation"),
    "simulate": ("lissajous.simulation", "simulate"),
    "BadInput": ("scanner.errors", "BadInput"),
    "Device": ("scanner.device", "Device"),
    "Grid": ("recon.imaging.picture", "Grid"),
    "Motion": ("scanner.motion", "Motion"),
    "Picture": ("recon.imaging.picture", "Picture"),
    "Recording": ("scanner.recording", "Recording"),
    "ScanDesign": ("lissajous.planning", "ScanDesign"),
    "ScanFrames": ("recon.sequences.frames", "ScanFrames"),
    "blur_study": ("lissajous.planning", "blur_study"),
    "catalogue": ("scanner.terms", "catalogue"),
    "compare_with_scene": ("recon.imaging.blur", "compare_with_scene"),
    "design": ("lissajous.planning", "design"),
    "frames": ("recon.sequences.frames", "frames"),
    "map_samples": ("recon.imaging.gridding", "map_samples"),
    "phase_bound": ("recon.imaging.blur", "phase_bound"),
    "register_effects": ("scanner.terms", "register"),
    "register_estimators": ("estimation.estimators", "register"),
    "register_readers": ("recon.io.readers", "register"),
}
"""Public names that are not defined in ``lissajous.functions``: name -> (module, name in that module)."""


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("lissajous")
    elif name in __all__:
        module, attribute = _DEFINED_ELSEWHERE.get(name, ("lissajous.functions", name))
        value = getattr(import_module(module), attribute)
    else:
        raise AttributeError(f"module 'lissajous' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
