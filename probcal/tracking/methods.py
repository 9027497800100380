"""The methods for detections without names, by their names on the command line."""

from probcal.inference.ea import EA
from probcal.inference.method import Method
from probcal.priors import Prior
from probcal.tracking.selfconfig import SelfConfiguration

METHODS: dict[str, tuple[Method, Prior | None]] = {
    "self-config": (SelfConfiguration(EA()), None),
    "self-config-beliefs": (SelfConfiguration(EA(), start="beliefs"), None),
}
