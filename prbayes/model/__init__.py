"""PLACEHOLDER package model."""
