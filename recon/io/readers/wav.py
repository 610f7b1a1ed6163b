"""WAV files, for scanners at audio rates; memory-mapped."""

from __future__ import annotations

import warnings
from pathlib import Path

from recon.io.readers.contents import Contents, Variable
from recon.io.readers.reader import Reader
from scanner.errors import BadInput


def read_wav(path: Path) -> Contents:
    """Channels of a WAV file as stored: integers are not scaled, because a WAV file does not state their unit.

    Samples of 24 bits cannot be mapped; they are read at once and multiplied by 256. A WAV file has 4 GB at most.

    Raises:
        BadInput: no such file, not WAV, or damaged.
    """
    from scipy.io import wavfile

    if not path.is_file():
        raise BadInput("no such file", file=path, hint="name the instrument's file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", wavfile.WavFileWarning)  # chunks that hold no samples
            warnings.filterwarnings("error", "Reached EOF", wavfile.WavFileWarning)
            try:
                rate, samples = wavfile.read(path, mmap=True)
            except ValueError as error:
                if "mmap" not in str(error):
                    raise
                rate, samples = wavfile.read(path)
    except MemoryError:
        raise
    except Exception as error:  # a damaged file can make the parser raise anything
        what = f"is not a whole WAV file: {error or type(error).__name__}"
        raise BadInput(what, file=path, hint="copy it again") from None
    if not samples.size:
        raise BadInput("holds no samples", file=path, hint="record it again")
    table = samples.reshape(len(samples), -1)
    note = f"{table.dtype}, in counts" if table.dtype.kind in "iu" else "1 is full scale"
    clock = float(rate) if rate > 0 else None
    variables = {f"CH{at + 1}": Variable(table[:, at], None, clock, 0.0, note) for at in range(table.shape[1])}
    return Contents("WAV", variables)


READER = Reader("wav", read_wav, beginnings=(b"RIFF", b"RIFX", b"RF64"), suffixes=(".wav",))
