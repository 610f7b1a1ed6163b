"""The complete diagnosis of a device: motion and readout against the nominal device, then the picture."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from estimation.device_fit.data import output_channels
from estimation.device_fit.fit import fit_model
from estimation.device_fit.model import Model
from estimation.device_fit.undriven import steady_without_drive
from estimation.diagnosis.diagnose import Diagnosis, diagnose
from estimation.diagnosis.finding import Finding
from estimation.diagnosis.selection import Progress
from estimation.held_samples import held_while_driven
from estimation.signals import require_device
from estimation.slow.diagnose import diagnose_decays, slow_decays
from estimation.slow.diagnose_response import diagnose_responses
from estimation.slow.steady_tones import frequency_responses
from scanner.channel import Channel
from scanner.device import AXES, Device
from scanner.errors import BadInput
from scanner.motion import Motion
from scanner.recording import Recording
from scanner.terms import catalogue

if TYPE_CHECKING:
    from estimation.optics.readout_effects import ReferencePhase

SENSED_STAGES = ("capacitance", "readout", "timing")
"""Stages whose terms change the phase of the motion that is estimated from the sense signal."""

Law = tuple[str, str]
"""A law that a device states: axis and effect."""

Terms = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""Laws with their values: axis -> effect -> parameter -> value."""

DETECTORS = {"sensor": "angle", "edges": "sync"}
"""Channels by which an estimator measures the motion of an axis directly."""

MeasureReference = Callable[[Recording, Device], "ReferencePhase | None"]
"""Measures the phase errors of the motion independently of the readout; None if the recording does not allow it."""

FollowSigns = Callable[[Motion, Device, Channel, float], tuple[Motion, list[str]]]
"""Makes the signs of a motion the same before and after a rest, by the intensity of a recording with a given start."""


def diagnose_with_optics(
    recordings: Sequence[Recording],
    device: Device | None = None,
    progress: Progress = lambda text: None,
    measure_reference: MeasureReference = lambda recording, device: None,
    follow_signs: FollowSigns = lambda motion, device, intensity, origin: (motion, []),
) -> Diagnosis:
    """Diagnose drive, mechanics and readout of all recordings together, then each that has an intensity by its picture.

    The picture of a recording without angle channels is the reference for the phase of the readout. If it shows an
    effect, the recordings are diagnosed again with that effect stated, because the nominal values and terms found
    without it have adapted to it. What the picture shows then belongs to the optics.

    A device that states no mechanics predicts no motion. If its recordings have an intensity, only readout and optics
    are diagnosed; so they are if sync edges alone show the motion.

    Args:
        recordings: of one device.
        device: the nominal one; None takes that of the first recording.
        progress: called with one line of text at every step.
        measure_reference: measures the phase by the picture.
        follow_signs: follows the signs of the motion by the picture.

    Raises:
        BadInput: no device, or a recording that cannot be compared with it.
    """
    nominal = require_device(recordings[0], device)
    diagnosis = _diagnose_motion(recordings, nominal, progress)
    pictures = [each for each in recordings if "intensity" in each and set(nominal.axes) == set(AXES)]
    try:
        return _diagnose_pictures(recordings, pictures, nominal, diagnosis, measure_reference, follow_signs, progress)
    except BadInput as error:
        if diagnosis.untested:
            raise
        return replace(diagnosis, untested=f"the picture, because it cannot be made ({error})")


def _diagnose_pictures(
    recordings: Sequence[Recording],
    pictures: Sequence[Recording],
    nominal: Device,
    diagnosis: Diagnosis,
    measure_reference: MeasureReference,
    follow_signs: FollowSigns,
    progress: Progress,
) -> Diagnosis:
    """The diagnosis with what the pictures show of the readout and the optics.

    A lag of the drive fits a sense signal as well as one of the readout, but shifts the mirror with it. Laws of the
    readout that the pictures refute are left out, and the recordings are diagnosed again.
    """
    refuted = list[Law]()
    while True:
        known = _sensed_laws(diagnosis, nominal)
        more = [law for law in _refuted_laws(pictures, nominal, known, measure_reference) if law not in refuted]
        if not more:
            break
        refuted += more
        diagnosis = _diagnose_motion(recordings, nominal, progress, [effect for _, effect in refuted])
    stated = nominal.with_terms(known)
    findings, stated = _diagnose_readout(pictures, stated, diagnosis, measure_reference, progress)
    if findings:
        without = _without_laws(stated, _names(known))
        again = _diagnose_motion(recordings, without, progress, [effect for _, effect in refuted])
        open_loop = {
            name: {**loops, "nominal": diagnosis.open_loop.get(name, loops)["nominal"]}
            for name, loops in again.open_loop.items()
        }
        diagnosis = replace(again, verdict="mismatch", findings=(*findings, *again.findings), open_loop=open_loop)
    diagnosis = replace(diagnosis, findings=tuple(_with_refuted(each, refuted) for each in diagnosis.findings))
    for recording in pictures:
        progress(f"optics of {recording.name}")
        diagnosis = add_optics(diagnosis, recording, follow_signs)
    return diagnosis


def _with_refuted(finding: Finding, refuted: Sequence[Law]) -> Finding:
    """A finding that states which laws of its axis the picture refutes."""
    effects = ", ".join(effect for axis, effect in refuted if axis == finding.axis)
    return replace(finding, where=f"{finding.where}; the picture refutes {effects}") if effects else finding


def _diagnose_motion(
    recordings: Sequence[Recording], nominal: Device, progress: Progress, refuted: Collection[str] = ()
) -> Diagnosis:
    """The diagnosis without pictures, and without the effects that they have refuted.

    It is empty if the recordings have pictures, and the device states no mechanics, sync edges alone show the motion,
    or the drive that keeps it up is missing.
    """
    pictures = any("intensity" in recording for recording in recordings)
    if pictures and not any(axis.mechanics for axis in nominal.axes.values()):
        if set(nominal.axes) != set(AXES):
            what = f"tests nothing: the device states no mechanics, and only the axis {', '.join(nominal.axes)}"
            raise BadInput(what, file=recordings[0].path, hint="state mechanics, or both axes for the picture")
        return _without_motion(nominal, "the device states no mechanics")
    edges = all(f"sync_{axis}" in recording.edges for recording in recordings for axis in nominal.axes)
    if pictures and edges and not any(output_channels(recording, nominal) for recording in recordings):
        return _without_motion(nominal, "only sync edges show the motion")
    steady = next(filter(None, (steady_without_drive(recording, nominal) for recording in recordings)), None)
    if steady is not None:
        if not pictures:
            raise BadInput(steady, file=recordings[0].path, hint="record the drive, or correct J and b of the device")
        return _without_motion(nominal, steady)
    for recording in recordings:
        if held := held_while_driven(recording, nominal):
            name, begin, end = held
            what = f"stands at one value from {begin:.6g} to {end:.6g} s while the axis is driven"
            hint = "diagnose a part without it (Recording.slice): a sensor or converter was stopped there"
            raise BadInput(what, file=recording.path, channel=name, hint=hint)
    responses = [frequency_responses(recording, nominal) for recording in recordings]
    if any(responses):
        if len(recordings) > 1:
            hint = "diagnose frequency responses one at a time"
            raise BadInput("a frequency response takes one recording", file=recordings[0].path, hint=hint)
        progress("frequency response")
        return diagnose_responses(responses[0], nominal)
    decays = [slow_decays(recording, nominal) for recording in recordings]
    if any(decays):
        if not all(decays):
            hint = "diagnose decays that are judged by their amplitude and other recordings apart"
            raise BadInput("is no free decay as another recording is", file=recordings[0].path, hint=hint)
        progress("amplitude of a free decay")
        return diagnose_decays([decay for of_one in decays for decay in of_one], nominal)
    return diagnose(recordings, nominal, progress, refuted)


def _without_motion(nominal: Device, reason: str) -> Diagnosis:
    """The diagnosis of recordings of which only the pictures are diagnosed."""
    return Diagnosis("consistent", (), None, nominal, None, untested=f"drive and mechanics, because {reason}")


def _sensed_laws(diagnosis: Diagnosis, nominal: Device) -> Terms:
    """The laws of a diagnosis that change the phase of the sensed motion, by axis and effect, with their values."""
    return {
        name: {
            effect: values
            for effect, values in axis.terms.items()
            if effect not in nominal.axes[name].terms
            and effect in catalogue()
            and catalogue()[effect].stage in SENSED_STAGES
        }
        for name, axis in diagnosis.device.axes.items()
    }


def _names(terms: Terms) -> list[Law]:
    return [(axis, effect) for axis, effects in terms.items() for effect in effects]


def _without_laws(device: Device, laws: Collection[Law]) -> Device:
    """A device without some of its laws."""
    axes = {
        name: replace(axis, terms={effect: each for effect, each in axis.terms.items() if (name, effect) not in laws})
        for name, axis in device.axes.items()
    }
    return replace(device, axes=axes)


def _diagnose_readout(
    pictures: Sequence[Recording],
    device: Device,
    diagnosis: Diagnosis,
    measure_reference: MeasureReference,
    progress: Progress,
) -> tuple[tuple[Finding, ...], Device]:
    """Findings of the readout that the pictures show in addition to what a device states, and the device with them.

    Args:
        diagnosis: whose evidence compares laws that the picture does not tell apart.
    """
    from estimation.optics.readout_selection import diagnose_readout

    findings, sense_evidence = tuple[Finding, ...](), _sense_evidence(diagnosis)
    for recording in pictures:
        if not any(f"angle_{axis}" in recording for axis in device.axes):
            progress(f"readout of {recording.name} against its picture")
            reference = measure_reference(recording, device)
            if reference is not None:
                found, device = diagnose_readout(reference, sense_evidence)
                findings = (*findings, *found)
    return findings, device


def _refuted_laws(
    pictures: Sequence[Recording], nominal: Device, known: Terms, measure_reference: MeasureReference
) -> list[Law]:
    """Laws of the readout with which a picture shows phase errors, while all pictures determine that there are none
    without: a single law where leaving it out suffices, else all."""
    from estimation.optics.readout_selection import demands_an_effect

    laws, stated = _names(known), nominal.with_terms(known)
    compared = [each for each in pictures if not any(f"angle_{axis}" in each for axis in nominal.axes)]
    if not (laws and compared):
        return []
    with_laws = [measure_reference(recording, stated) for recording in compared]
    if not any(each is not None and demands_an_effect(each) for each in with_laws):
        return []
    for refuted in [*([law] for law in laws), laws]:
        without = [measure_reference(recording, _without_laws(stated, refuted)) for recording in compared]
        determined = [each for each in without if each is not None and np.all(np.isfinite(each.sd))]
        if len(determined) == len(compared) and not any(map(demands_an_effect, determined)):
            return refuted
    return []


def _sense_evidence(diagnosis: Diagnosis) -> Callable[[Device], float]:
    """-2 log evidence of the recordings under a device, with the other terms of ``diagnosis`` fitted."""
    search = diagnosis.search
    if search is None:
        return lambda device: 0.0
    final = search.final

    def evidence(device: Device) -> float:
        terms = [c for c in final.model.candidates if c.term.effect not in device.axes[c.axis].terms]
        model = Model(final.model.runs, device, terms, final.model.mains)
        fit = fit_model(search.likelihood, model, model.map_parameters_from(final.model, final.x))
        return fit.neg2_log_evidence

    return evidence


def add_optics(diagnosis: Diagnosis, recording: Recording, follow_signs: FollowSigns) -> Diagnosis:
    """Return the diagnosis with the optical effects that the picture of one recording shows.

    The motion is estimated with the improved device of ``diagnosis``, so that its terms are not diagnosed again. An
    effect that is found beside a term of the same name is added to it.
    """
    from estimation.estimate import estimate
    from estimation.optics.correction import beam_motion, correct_intensity
    from estimation.optics.selection import diagnose_optics
    from estimation.optics.stated_effects import describe_total, with_remainders

    device = diagnosis.device
    corrected = correct_intensity(recording, device)
    motion, _ = follow_signs(estimate(corrected, device), device, corrected["intensity"], corrected.start)
    motion = beam_motion(motion, device, corrected.start)
    kind, recorded = DETECTORS.get(motion.estimator), {*recording.channels, *recording.edges}
    detectors = {axis: f"{kind}_{axis}" for axis in AXES if f"{kind}_{axis}" in recorded} if kind else {}
    optics = diagnose_optics(motion, corrected["intensity"], device, detectors)
    improved = with_remainders(device, optics.terms)
    return replace(
        diagnosis,
        verdict="mismatch" if optics.findings else diagnosis.verdict,
        findings=(*diagnosis.findings, *(describe_total(each, device, improved) for each in optics.findings)),
        device=improved,
        optics=(*diagnosis.optics, {"recording": recording.name, "effects": optics.to_json()}),
    )
