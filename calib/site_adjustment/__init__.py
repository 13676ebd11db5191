"""All sensors and references of a site in one adjustment, and who contradicts the others. Begin with `site.py`."""
