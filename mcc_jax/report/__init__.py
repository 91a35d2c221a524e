"""The report: one self-contained HTML page from what a folder of results holds."""

from .page import report_page as report_page
from .read import Results as Results
from .read import read_results as read_results
