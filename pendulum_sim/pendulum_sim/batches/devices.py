"""Where batches run: on the processor, or on a GPU that numba's CUDA target can use."""

from __future__ import annotations

from functools import cache

from pendulum_msgs_py.errors import FaultError, ParameterError

__all__ = ["DEVICES", "resolve_device"]

DEVICES = ("cpu", "cuda", "auto")


def resolve_device(device: str) -> str:
    """Return where a batch runs, ``cpu`` or ``cuda``.

    Args:
        device: One of ``DEVICES``; ``auto`` is the GPU where there is one.

    Raises:
        ParameterError: There is no such device.
        FaultError: It is ``cuda``, and numba finds no GPU.
    """
    if device not in DEVICES:
        raise ParameterError(f"device is {device!r}; expected one of {', '.join(DEVICES)}")
    if device == "cuda" and (fault := _fault()):
        raise FaultError(
            f"device is 'cuda', but numba finds no GPU here: {fault}; expected an NVIDIA driver and "
            "pendulum_sim[cuda], or device cpu"
        )
    return "cuda" if device != "cpu" and not _fault() else "cpu"


@cache
def _fault() -> str:
    """Return why there is no GPU; empty where there is one."""
    from numba import cuda

    if cuda.is_available():
        return ""
    try:
        cuda.current_context()
    except Exception as error:  # noqa: BLE001  (of the driver, of several kinds)
        return " ".join(str(error).split()).partition(". ")[0].strip(" .:")
    return "none is listed"
