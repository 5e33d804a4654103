"""Modules for numerics outside JAX programs."""

import equinox as eqx


class Record(eqx.Module):
    """A module whose methods are plain methods.

    Those of an equinox module are modules too, so that they may be arguments of JAX programs. Each look-up makes one,
    which takes longer than the work of a short method.
    """

    __getattribute__ = object.__getattribute__
