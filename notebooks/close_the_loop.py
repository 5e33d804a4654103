# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Close the loop with a log
#
# A drive hides an effect that its drive file does not mention. The loop fits the base model, names the effect, and
# compares both models on the part of the logs that no fit has used.

# %%
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)

from fitting.commands.demo import hidden_truth, write_demo_logs
from fitting.drive_data import read_rig
from fitting.loop import close_loop

# %% [markdown]
# ## The logs
# Two runs of a simulated rig: motor and load encoder with noise, and the motor torque as the drive commanded it.

# %%
with TemporaryDirectory() as folder:
    logs, drive_file = write_demo_logs(Path(folder), seconds=4.0)
    rig = read_rig(logs, drive_file)

log = rig.logs[0]
figure, axes = plt.subplots(3, 1, sharex=True, figsize=(9, 6), layout="constrained")
axes[0].plot(log.time, log.motor_torque, lw=0.5)
axes[0].set_ylabel("motor torque [N m]")
axes[1].plot(log.time, log.motor_angle)
axes[1].set_ylabel("motor angle [rad]")
axes[2].plot(log.time, 1e3 * log.dynamic_error, lw=0.5)
axes[2].set_ylabel("dynamic error [mrad]")
axes[2].set_xlabel("time [s]")
# %% [markdown]
# ## The loop
# Starting values come from the weak form of the equation of motion. The last 20 % of each log is test data, which only
# the figures at the end use.

# %%
hold = rig.hold
loop = close_loop(rig.model, {hold: rig.experiments[hold]}, test={hold: rig.test[hold]}, hold=hold)
print(loop.decision)
for finding in loop.findings:
    print(f"{finding.family}: removes {finding.gain:.1%} of the error on selection data, p = {finding.p_value:.3f}")

# %% [markdown]
# ## Before and after
# The initial state comes from 50 samples; from there on the models run alone.

# %%
before, after = loop.before.test[0], loop.after.test[0]
figure, axes = plt.subplots(2, 1, sharex=True, figsize=(9, 5), layout="constrained")
axes[0].plot(before.time, 1e6 * before.measured, color="0.6", lw=0.8, label="measured")
axes[0].plot(after.time, 1e6 * after.predicted, color="#0072B2", lw=0.8, label="predicted, after")
axes[0].set_ylabel("dynamic error [µrad]")
axes[0].legend(loc="upper right", ncols=2)
for run, colour, name in ((before, "#D55E00", "before"), (after, "#0072B2", "after")):
    label = f"{name}: {1e6 * run.rmse:.2f} µrad rms"
    axes[1].plot(run.time, 1e6 * (run.measured - run.predicted), color=colour, lw=0.8, label=label)
axes[1].set_ylabel("left over [µrad]")
axes[1].set_xlabel("time [s]")
axes[1].legend(loc="upper right", ncols=2)
# %% [markdown]
# ## Was it right?
# The truth is used only here. Without the effect the drive's own parameters are biased as well.

# %%
truth = hidden_truth()
print(f"{'':12}{'truth':>12}{'before':>12}{'after':>12}{'std':>10}")
for path in ("K", "alpha", "B_sp"):
    wrong = loop.before.uncertainty.estimates[path].value
    right = loop.after.uncertainty.estimates[path]
    print(f"{path:12}{float(truth.get(path)):12.5g}{wrong:12.5g}{right.value:12.5g}{right.std:10.2g}")

amplitude = np.hypot(*(float(loop.after.model.get(f"kinematic_error.{p}")) for p in ("cos_2", "sin_2")))
print(f"kinematic error, two per revolution: {1e6 * amplitude:.2f} µrad, truth 150.00 µrad")
assert [f.family for f in loop.findings] == ["kinematic_error"]
assert abs(amplitude - 1.5e-4) < 1e-6
