"""From raw samples of a microphone or geophone to received levels: band-pass, windows, decibels."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from probcal.errors import InputError
from probcal.files import AnyPath
from probcal.lazy import pd

ORDER = 4  # of the Butterworth band-pass, run forwards and backwards
QUIET = 1e-30  # mean square below which a window holds nothing


def read_wav(path: AnyPath) -> tuple[np.ndarray, float]:
    """Samples (N, channels) of a WAV file, whole numbers scaled to [-1, 1), and their rate in Hz.

    Raises `InputError` naming the file where it is missing, is no WAV file or holds nothing.
    """
    from scipy.io import wavfile

    where = Path(path)
    if not where.is_file():
        raise InputError(f"{where}: no such file")
    try:
        rate, samples = wavfile.read(where)
    except (ValueError, EOFError) as error:
        raise InputError(f"{where.name} is no WAV file that can be read: {error}") from None
    if not len(samples):
        raise InputError(f"{where.name} holds no samples")
    samples = samples.reshape(len(samples), -1)
    if samples.dtype.kind == "u":
        return (samples.astype(float) - 128.0) / 128.0, float(rate)
    if samples.dtype.kind == "i":
        return samples / -float(np.iinfo(samples.dtype).min), float(rate)
    return samples.astype(float), float(rate)


def levels_of(
    samples: np.ndarray,
    rate: float,
    *,
    band: tuple[float, float] | None = None,
    window: float = 0.5,
    start: float = 0.0,
    reference: float = 1.0,
    column: str = "level",
) -> pd.DataFrame:
    """Received levels in dB of raw samples (N,): columns `time` in s and `column` (RSS paper, section 2).

    `rate` in Hz; `band` passes frequencies (low, high) in Hz; the mean square of each whole `window` in s becomes
    10 log10 of it over `reference` squared, at the middle of the window, counted from `start` in s. A window without
    any signal is left out: its level would be minus infinity. Raises `InputError` for samples that are not finite, a
    band that the rate cannot hold, and fewer samples than one window.

    >>> t = np.arange(8000) / 1000.0
    >>> float(levels_of(np.sin(2 * np.pi * 50 * t), 1000.0, band=(20.0, 100.0))["level"].iloc[4].round(1))
    -3.0
    """
    from scipy import signal

    raw = np.asarray(samples, float)
    if raw.ndim != 1 or not np.isfinite(raw).all():
        raise InputError(f"levels_of: give finite samples (N,) of one channel, got shape {raw.shape}")
    if not (np.isfinite(rate) and rate > 0 and np.isfinite(window) and window > 0 and reference > 0):
        raise InputError(f"levels_of: rate {rate}, window {window} and reference {reference} must be positive")
    length = round(window * rate)
    if length < 2 or len(raw) < length:
        raise InputError(f"levels_of: {len(raw)} samples at {rate:g} Hz are less than one window of {window:g} s")
    if band is not None:
        low, high = band
        if not 0 < low < high < rate / 2:
            raise InputError(f"levels_of: band {band} must lie between 0 and half the rate, {rate / 2:g} Hz")
        sections = signal.butter(ORDER, (low, high), "bandpass", fs=rate, output="sos")
        raw = signal.sosfiltfilt(sections, raw - raw.mean(), padlen=min(3 * length, len(raw) - 1))
    count = len(raw) // length
    power = (raw[: count * length].reshape(count, length) ** 2).mean(1)
    time = start + (np.arange(count) + 0.5) * length / rate
    heard = power > QUIET
    return pd.DataFrame({"time": time[heard], column: 10 * np.log10(power[heard] / reference**2)})
