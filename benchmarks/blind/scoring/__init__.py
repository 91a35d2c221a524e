"""Answers against discoveries: the acceptance table, what stands beside it, and pictures."""

from ._acceptance import acceptance as acceptance
from ._closing import closure_error as closure_error
from ._closing import curve_error as curve_error
from ._outcome import Outcome as Outcome
from ._pictures import pictures as pictures
from ._reliability import reliability as reliability
from ._summaries import against_ideal as against_ideal
from ._summaries import by_mechanism as by_mechanism
from ._summaries import by_noise as by_noise
from ._summaries import confusion as confusion
from ._summaries import confusion_rows as confusion_rows
from ._summaries import failures as failures
from ._summaries import gaps as gaps
from ._table import interval as interval
