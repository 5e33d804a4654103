# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Three routes to one fit
#
# A fit compares a log with simulations of its segments. The plain way to simulate them is `diffrax.diffeqsolve`,
# jit-compiled and vmapped over the segments, with adaptive steps. hdjax has two faster ways to evaluate the same
# residual. One takes fixed steps by a program that XLA compiles; the other takes the same steps by machine code of its
# own. All three use the same least-squares solver of optimistix. Here they fit the same log.

# %%
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import jax

jax.config.update("jax_enable_x64", True)

from fitting.commands.demo import write_demo_logs
from fitting.drive_data import read_rig
from fitting.estimation.estimate import fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import fitted_paths
from fitting.estimation.problem import Segmentation
from fitting.estimation.starting_values import starting_models
from fitting.uncertainty.standard_errors import uncertainty

with TemporaryDirectory() as folder:
    logs, drive_file = write_demo_logs(Path(folder), seconds=4.0)
    rig = read_rig(logs, drive_file)

data = [Stretch(rig.experiments[rig.hold][0], 0, 3000)]
start = starting_models(rig.model, data)[0]

# %% [markdown]
# ## The fits
# Each simulation starts anew after 128 samples. Both marches take three steps of Tsit5 in a sample interval. The times
# include what is compiled.

# %%
fits = {}
for engine in (None, "XLA", "diffrax"):
    begun = time.perf_counter()
    fits[engine] = fit(start, data, fitted_paths(start), Segmentation(128, substeps=3), engine=engine)
    print(f"{engine or 'machine code':>12}: {fits[engine].steps} iterations, {time.perf_counter() - begun:.1f} s")

# %% [markdown]
# ## The parameters
# Differences are in units of the standard error.

# %%
first = fits[None]
errors = uncertainty(first, torque_noise=False).estimates
print(f"{'':8}{'machine code':>16}{'std':>12}{'XLA':>12}{'diffrax':>12}")
for path in ("K", "alpha", "B_sp"):
    value, std = float(first.model.get(path)), errors[path].std
    apart = [(float(fits[e].model.get(path)) - value) / std for e in ("XLA", "diffrax")]
    print(f"{path:8}{value:16.8g}{std:12.2g}{apart[0]:12.1e}{apart[1]:12.1e}")
    assert max(map(abs, apart)) < 0.01
