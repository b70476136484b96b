"""PLACEHOLDER package estimate."""
