"""Whether Warp's kernels run where JAX computes."""

import importlib.util

import jax


def warp_problem() -> str:
    """Why Warp does not run on JAX's default device, an NVIDIA GPU or a CPU; '' if it does.

    Warp and JAX may be built for two versions of CUDA, which need two drivers.
    """
    if importlib.util.find_spec("warp") is None:
        return "warp-lang is not installed; pip install 'jaxsafe[gpu]'"
    if jax.default_backend() == "cpu":
        return ""
    import warp as wp  # late: it is slow to import

    wp.config.log_level = wp.LOG_WARNING
    if wp.is_cuda_available():
        return ""
    built, driver = (
        ".".join(map(str, version or ("unknown",)))
        for version in (wp.get_cuda_toolkit_version(), wp.get_cuda_driver_version())
    )
    return (
        f"warp-lang {wp.__version__} finds no GPU: it is built for CUDA {built}, and the driver is for "
        f"CUDA {driver}; update the driver, or take a wheel of Warp for it from "
        "https://github.com/NVIDIA/warp/releases"
    )
