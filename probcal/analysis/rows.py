"""Innovation of every datum, and PSIS-LOO of its row."""

import xarray as xr

from probcal.analysis import leave
from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import Finding
from probcal.analysis.verdict import RATE
from probcal.inference.residuals import codes
from probcal.results.groups import along


@check()
def check_rows(case: Case) -> Checked:
    """Innovation of every datum, and PSIS-LOO of its row where the tree holds the log-likelihood."""
    data, found, tree = case.fit.data, case.innovations, case.tree
    values = {"innovation": found.value}
    used, texts = float(found.used.sum()), list[str]()
    attrs = {"nis": float((found.value**2).sum()) / max(len(data) - used, 1e-9), "used": used}
    if "log_likelihood_sum" in tree.children:
        texts.append(f"PSIS-LOO is left out: of {len(data)} data a fit keeps the log-likelihood of all, not of each")
    if leave.tailed(tree):
        number, labels = codes(data, ["row", "sensor", "target", "time"])
        row = leave.psis(tree, number, len(labels))
        values |= {"elpd": row.elpd[number], "pareto_k": row.pareto_k[number]}
        good = leave.good_k(tree)
        attrs |= {"elpd": float(row.elpd.sum()), "elpd_se": leave.standard_error(row.elpd), "good_k": good}
        bad = int((row.pareto_k > good).sum())
        if bad > RATE * len(labels):
            texts.append(
                f"PSIS-LOO: Pareto k of {bad} of {len(labels)} rows is above {good:.2f}: its elpd is uncertain"
            )
    elif "log_likelihood" in tree.children:
        texts.append(f"PSIS-LOO and power scaling are left out: they need {leave.TAILED} draws at least, take more")
    named = ("sensor", "channel", "target")
    coords = {name: ("datum", data[name].to_numpy(str if name in named else None)) for name in data}
    group = xr.Dataset(along("datum", values), coords, attrs)
    return Checked({"datum_check": group}, [Finding("loo", "rows", text) for text in texts])
