"""WAV files: samples as a fraction of the full scale."""

import warnings
from functools import partial
from pathlib import Path

import numpy as np

from bayesperiodic.data.formats.contents import Clock, Contents, Key, StoredChannel


def contents(file: Path, wanted: list[Key]) -> Contents:
    """Return the channels of a WAV file, integers divided by their full scale, floats as they are."""
    from scipy.io import wavfile

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Chunk .non-data. not understood", wavfile.WavFileWarning)
        warnings.simplefilter("error", wavfile.WavFileWarning)  # such as of a file that is cut off
        rate, samples = wavfile.read(file)
    table, clock = samples.reshape(len(samples), -1), Clock(step=1.0 / rate)
    # SciPy 1.18 returns 24 bits as the upper ones of 32, so that the full scale is that of its type.
    scale = 1.0 if samples.dtype.kind == "f" else 2.0 ** (8 * samples.dtype.itemsize - 1)
    middle = 128.0 if samples.dtype.kind == "u" else 0.0
    channels = tuple(
        StoredChannel(f"channel {k + 1}", len(table), partial(_scaled, table[:, k], middle, scale), clock=clock)
        for k in range(table.shape[1])
    )
    given = "as stored" if samples.dtype.kind == "f" else "as a fraction of the full scale"
    remark = f"values are {given}: give the full scale in the unit of the sensor as a factor, units={{'x': 10.0}}"
    return Contents("WAV file", channels, (remark,))


def _scaled(values: np.ndarray, middle: float, scale: float) -> np.ndarray:
    return (values - middle) / scale if scale != 1.0 or middle else values
