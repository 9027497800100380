"""From and to what users have: Stone Soup, ROS bags, AIS, ADS-B and GeoJSON; each ends in the long table.

Angles are mathematical, in radians (0 east, counter-clockwise): nautical courses and headings are converted. What a
reader returns says in `.attrs["start"]` which instant its time 0 is.
"""

from typing import TYPE_CHECKING

from probcal.lazy import lazy

if TYPE_CHECKING:
    from probcal.adapters.adsb import read_adsb
    from probcal.adapters.ais import read_ais
    from probcal.adapters.geojson import read_geojson, write_geojson
    from probcal.adapters.ros import FromField, Topic, read_bag
    from probcal.adapters.stone_soup.detections import by_time, from_detections, to_detections
    from probcal.adapters.stone_soup.measurement import measurement_model
    from probcal.adapters.stone_soup.sensors import to_sensors
    from probcal.adapters.stone_soup.tracks import from_tracks, to_tracks

__all__ = lazy(
    __name__,
    {
        "probcal.adapters.adsb": "read_adsb",
        "probcal.adapters.ais": "read_ais",
        "probcal.adapters.geojson": "read_geojson write_geojson",
        "probcal.adapters.ros": "FromField Topic read_bag",
        "probcal.adapters.stone_soup.detections": "by_time from_detections to_detections",
        "probcal.adapters.stone_soup.measurement": "measurement_model",
        "probcal.adapters.stone_soup.sensors": "to_sensors",
        "probcal.adapters.stone_soup.tracks": "from_tracks to_tracks",
    },
)
