"""Surfaces, frames, rays, closest points and sections, for the packages body and contact."""
