"""Checks the shapes and types that `envs` declares while its tests run."""

from jaxtyping import install_import_hook

install_import_hook("envs", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")
