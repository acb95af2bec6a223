"""Which OpenGL can draw here without a screen; and an import of MuJoCo that survives where none can.

With `MUJOCO_GL` set to a platform whose library is missing, `import mujoco` itself fails. A machine that only
computes shall not care, so the variable is hidden during the import; this module comes before all others.
"""

import ctypes
import os
import sys

LIBRARIES = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}  # platform -> what it loads
WINDOWED = ("glfw", "cgl")  # platforms of machines with a screen, whose libraries MuJoCo finds itself


def loads(platform: str) -> bool:
    """Whether the library of a platform is there."""
    try:
        ctypes.CDLL(LIBRARIES[platform])
    except OSError:
        return False
    return True


def choose_platform() -> str:
    """The platform that `MUJOCO_GL` asks for, or the first that can be loaded.

    Raises:
        OSError: if it cannot be loaded, or none can, or drawing is disabled.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    if wanted in WINDOWED or (not wanted and sys.platform != "linux"):
        return wanted or "glfw"
    if wanted and wanted not in LIBRARIES:
        raise OSError(f"MUJOCO_GL={wanted}")
    for platform in [wanted] if wanted else LIBRARIES:
        if loads(platform):
            return platform
    missing = LIBRARIES[wanted] if wanted else " nor ".join(LIBRARIES.values())
    raise OSError(f"no {missing} can be loaded")


def import_mujoco() -> None:
    """Import MuJoCo even if the library that `MUJOCO_GL` names is missing."""
    wanted = os.environ.get("MUJOCO_GL", "")
    if wanted.lower() in LIBRARIES and not loads(wanted.lower()):
        os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco  # noqa: F401
    finally:
        if wanted:
            os.environ["MUJOCO_GL"] = wanted


import_mujoco()
