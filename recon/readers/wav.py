"""WAV, for scanners at audio rates, mapped rather than read."""

from __future__ import annotations

import warnings
from pathlib import Path

from recon.readers.contents import Contents, Variable
from scanner.errors import BadInput


def read_wav(path: Path) -> Contents:
    """Channels of a WAV file as they were stored, whole numbers as whole numbers: what one stands for, no WAV states.

    Samples of 24 bits cannot be mapped and are read at once, times 256; a WAV of any kind holds 4 GB at most.

    Raises:
        BadInput: no such file, no WAV, or a damaged one.
    """
    from scipy.io import wavfile

    if not path.is_file():
        raise BadInput("no such file", file=path, hint="name the instrument's file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", wavfile.WavFileWarning)  # chunks that are no sound
            try:
                rate, samples = wavfile.read(path, mmap=True)
            except ValueError as error:
                if "mmap" not in str(error):
                    raise
                rate, samples = wavfile.read(path)
    except MemoryError:
        raise
    except Exception as error:  # the parser stumbles in as many ways as a file can be damaged
        what = f"is not a whole WAV file: {error or type(error).__name__}"
        raise BadInput(what, file=path, hint="copy it again") from None
    table = samples.reshape(len(samples), -1)
    note = f"{table.dtype}, in counts" if table.dtype.kind in "iu" else "1 is full scale"
    clock = float(rate) if rate > 0 else None
    variables = {f"CH{at + 1}": Variable(table[:, at], None, clock, 0.0, note) for at in range(table.shape[1])}
    return Contents("WAV", variables)
