"""Plots of a fit or a closed loop, as plotly figures in plain dictionaries. Statistics are computed elsewhere."""

from fitting.report.plots.evidence import evidence_plot as evidence_plot
from fitting.report.plots.gallery import fit_plots as fit_plots
from fitting.report.plots.gallery import plots as plots
from fitting.report.plots.learned import learned_plot as learned_plot
from fitting.report.plots.learned import response_plot as response_plot
from fitting.report.plots.long_trace import decimated as decimated
from fitting.report.plots.next_experiment import next_experiment_plot as next_experiment_plot
from fitting.report.plots.plot import Plot as Plot
