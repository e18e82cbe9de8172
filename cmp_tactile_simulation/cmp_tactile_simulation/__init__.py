"""Simulator of vision-based tactile sensors: elastomer, contact, mirror optics, camera."""
