"""Surfaces, frames, rays, closest points and sections: what body and contact both need."""
