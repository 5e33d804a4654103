"""Reports of a fit or a closed loop: page, terminal text and JSON."""

from fitting.report.content import report_dict as report_dict
from fitting.report.separating import separating_experiment as separating_experiment
from fitting.report.text import report_text as report_text
from fitting.report.unexplained import explained_share as explained_share
from fitting.report.write import Report as Report
