"""Inference: `fit(problem, method)` for every method, `track` for other data."""

from typing import TYPE_CHECKING

from probcal.lazy import lazy

if TYPE_CHECKING:
    from probcal.gaussian.esteps import Cubature, EStep, Extended, Unscented
    from probcal.inference.evidence import Evidence, log_evidence
    from probcal.inference.fit import calibrate, fit
    from probcal.inference.method import Method
    from probcal.inference.methods import (
        EA,
        EM,
        EMEA,
        MAP,
        MCMC,
        METHODS,
        NUTS,
        Collapsed,
        Gibbs,
        LeastSquares,
        table,
    )
    from probcal.inference.model import numpyro_model
    from probcal.inference.svi import SVI
    from probcal.inference.track import track

__all__ = lazy(
    __name__,
    {
        "probcal.inference.evidence": "Evidence log_evidence",
        "probcal.inference.fit": "calibrate fit",
        "probcal.inference.method": "Method",
        "probcal.inference.methods": "EA EM EMEA MAP MCMC METHODS NUTS Collapsed Gibbs LeastSquares table",
        "probcal.inference.model": "numpyro_model",
        "probcal.inference.svi": "SVI",
        "probcal.inference.track": "track",
        "probcal.gaussian.esteps": "Cubature EStep Extended Unscented",
    },
)
