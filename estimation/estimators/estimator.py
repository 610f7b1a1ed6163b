"""What an estimator of motion states about itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording


@dataclass(frozen=True)
class Estimator:
    """One way from a recording to its motion.

    Attributes:
        name: by which users choose it.
        summary: what it does, in one line.
        needs: channels and parts of the device that it needs.
        use_when: what it is the right choice for.
        run: motion of all axes of a device without terms; raises BadInput for what it cannot use. It imports what it
            computes with only when it is called: the command line lists all estimators and has to be quick.
        source: paper or method.
        is_model_based: whether the angle follows from a nominal model, so that harmonics that the device's terms add
            to the motion are added to it. False where the angle is a sensor's, which has them already.
        treats_clipping: whether it takes samples at a rail as clipped, not as measured.
        resume: like ``run``, continued from the motion of an earlier segment of the same scan; None if it cannot.
    """

    name: str
    summary: str
    needs: str
    use_when: str
    run: Callable[[Recording, Device], Motion]
    source: str
    is_model_based: bool = True
    treats_clipping: bool = False
    resume: Callable[[Recording, Device, Motion], Motion] | None = None
