# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Ten lines
#
# Load the logs of a drive, fit the base model, look for what it lacks, and use the identified model. The drive is
# simulated and hides an effect that its drive file does not mention. Each result has a view in a notebook.

# %%
import jax

jax.config.update("jax_enable_x64", True)

from pathlib import Path
from tempfile import mkdtemp

import fitting
from fitting.commands.demo import write_demo_logs

logs, drive_file = write_demo_logs(Path(mkdtemp()), seconds=2.0)

# %% [markdown]
# ## Load
# Logs are paths, frames of pandas or polars, or arrays by name. Here the second log is kept for a comparison.

# %%
data = fitting.load(logs[0], drive=drive_file)
data

# %% [markdown]
# ## Fit the base model
# Without starting values: stiffness K, its cubic coefficient alpha and mesh damping B_sp.

# %%
fit = fitting.fit(data)
fit

# %% [markdown]
# The residual is far from white noise: the base model lacks something.

# %%
fit.plot("spectrum")
# %% [markdown]
# ## Close the loop
# The last fifth of the log is test data, which only the figures at the end use.

# %%
loop = fitting.close_loop(data)
loop

# %%
loop.effects

# %%
loop.rules

# %%
loop.plot("prediction")
# %% [markdown]
# ## Use the identified model
# Both models run along the other log. Its outputs are used in the first 50 samples only.

# %%
other = fitting.load(logs[1], drive=drive_file)
fitting.compare({"base model": fit, "with the effect": loop}, other).table

# %% [markdown]
# The report on disk, for a browser and for programs:

# %%
loop.save(Path(mkdtemp()) / "report")
assert loop.decision == "effect_found"
assert list(loop.effects["family"]) == ["kinematic_error"]
