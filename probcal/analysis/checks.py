"""The table of checks: `assess` runs each whose needs a fit meets.

Of several doubts about one bias the last stands.
"""

from probcal.analysis.channels import check_channels
from probcal.analysis.check import Check
from probcal.analysis.epochs import check_epochs
from probcal.analysis.lags import check_lags
from probcal.analysis.levels import check_levels
from probcal.analysis.mirrors import check_mirrors
from probcal.analysis.open import check_open
from probcal.analysis.outliers import check_outliers
from probcal.analysis.parts import check_parts
from probcal.analysis.process import check_process
from probcal.analysis.recoded import check_recoded
from probcal.analysis.ridges import check_ridges
from probcal.analysis.rows import check_rows
from probcal.analysis.scaling import check_scaling
from probcal.analysis.segments import check_segments
from probcal.analysis.shape import check_shape
from probcal.analysis.slopes import check_slopes
from probcal.analysis.wrapping import check_wrapping

CHECKS: dict[str, Check] = {
    "epochs": check_epochs,
    "rows": check_rows,
    "channels": check_channels,
    "sensors": check_parts("sensor"),
    "targets": check_parts("target"),
    "outliers": check_outliers,
    "wrapping": check_wrapping,
    "recoded": check_recoded,
    "process": check_process,
    "open": check_open,
    "levels": check_levels,
    "segments": check_segments,
    "slopes": check_slopes,
    "shape": check_shape,
    "ridges": check_ridges,
    "mirrors": check_mirrors,
    "lags": check_lags,
    "scaling": check_scaling,
}
