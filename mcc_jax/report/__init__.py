"""The report: one self-contained HTML page from what a folder of results holds."""

from ._page import report_page as report_page
from ._read import Results as Results
from ._read import read_results as read_results
