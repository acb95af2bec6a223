"""Reading MuJoCo models: whole, to be drawn, and stripped, to be stepped."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco

# pyright: reportAttributeAccessIssue=false
# (mujoco takes its names from compiled modules, which pyright cannot read)

DEPRECATED = "'settotalmass' is deprecated"  # in Gymnasium's half_cheetah.xml, nothing its users can change


@contextmanager
def _without_deprecation() -> Iterator[None]:
    """Keep MuJoCo from printing about Gymnasium's models and from leaving MUJOCO_LOG.TXT behind."""

    def pass_on(message: str) -> None:
        if DEPRECATED not in message:
            warnings.warn(message, stacklevel=2)

    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(pass_on)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


def load(path: Path) -> mujoco.MjModel:
    """The model of a file."""
    with _without_deprecation():
        return mujoco.MjModel.from_xml_path(str(path))


def stripped(path: Path) -> mujoco.MjModel:
    """The model of a file without what only the eye needs: geoms, lights, cameras, sites, drawn ropes.

    Only for models without contacts whose bodies give their inertia explicitly. Trajectories are those of the
    whole model to the last bit; a step is cheaper because nothing is placed that nobody looks at.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    moved_by_hand = [body for body in spec.bodies if body.mocap]
    for group in (spec.tendons, spec.geoms, spec.lights, spec.cameras, spec.sites, moved_by_hand):
        for element in group:
            spec.delete(element)
    return spec.compile()
