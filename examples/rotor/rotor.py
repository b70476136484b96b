"""A small rotor: beam finite elements, springs and dampers at the bearings, a disc, a rub.

A shaft of 10 mm carries a disc of 0.8 kg between two journal bearings and turns at 3600 rpm. Two
responses:

- ``first_frequency(k, c)``: first natural frequency in Hz, of the shaft at rest, as an impact test
  finds it;
- ``crest_factor(k, c, contact)``: peak over RMS of the vibration while a screw rubs on the shaft.

Both take arrays of any shape, one entry per specimen. Deflections in the two planes are one complex
number, ``x + i y``, since shaft and bearings are the same in both. What is assumed or tuned is
listed in README.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.linalg import eigh, lu_factor, lu_solve


@dataclass(frozen=True)
class Shaft:
    """A round steel shaft, in m, Pa, kg/m^3."""

    diameter: float = 0.010
    youngs_modulus: float = 210e9
    poisson: float = 0.3
    density: float = 7850.0
    shear: bool = True  # False: Euler-Bernoulli

    @property
    def area(self):
        return np.pi * self.diameter**2 / 4

    @property
    def inertia(self):
        """Second moment of area."""
        return np.pi * self.diameter**4 / 64

    @property
    def bending(self):
        """Bending stiffness EI."""
        return self.youngs_modulus * self.inertia

    @property
    def shear_stiffness(self):
        """Kappa G A, with Cowper's shear coefficient of a solid circle (1966)."""
        kappa = 6 * (1 + self.poisson) / (7 + 6 * self.poisson)
        return kappa * self.youngs_modulus / (2 * (1 + self.poisson)) * self.area

    def element(self, length):
        """Return mass, gyroscopic and stiffness matrix of an element, (v, slope) at both ends.

        Friswell, Penny, Garvey and Lees, Dynamics of Rotating Machines (2010), section 5.4.
        """
        el, p = (
            length,
            12 * self.bending / (self.shear_stiffness * length**2) if self.shear else 0.0,
        )
        stiffness = np.array([
            [12, 6 * el, -12, 6 * el],
            [6 * el, (4 + p) * el**2, -6 * el, (2 - p) * el**2],
            [-12, -6 * el, 12, -6 * el],
            [6 * el, (2 - p) * el**2, -6 * el, (4 + p) * el**2],
        ]) * self.bending / ((1 + p) * el**3)  # fmt: skip
        m1, m2, m3 = (
            312 + 588 * p + 280 * p**2,
            (44 + 77 * p + 35 * p**2) * el,
            108 + 252 * p + 140 * p**2,
        )
        m4 = -(26 + 63 * p + 35 * p**2) * el
        m5 = (8 + 14 * p + 7 * p**2) * el**2
        m6 = -(6 + 14 * p + 7 * p**2) * el**2
        translation = np.array(
            [[m1, m2, m3, m4], [m2, m5, -m4, m6], [m3, -m4, m1, -m2], [m4, m6, -m2, m5]]
        )
        m7 = 36.0
        m8 = (3 - 15 * p) * el
        m9 = (4 + 5 * p + 10 * p**2) * el**2
        m10 = (-1 - 5 * p + 5 * p**2) * el**2
        rotation = np.array(
            [[m7, m8, -m7, m8], [m8, m9, -m8, m10], [-m7, -m8, m7, -m8], [m8, m10, -m8, m9]]
        )
        rotary = self.density * self.inertia / (30 * (1 + p) ** 2 * el) * rotation
        mass = self.density * self.area * el / (840 * (1 + p) ** 2) * translation + rotary
        return (
            mass,
            2 * rotary,
            stiffness,
        )  # the polar moment of a circle is twice the diametral one


def assemble(shaft, lengths):
    """Return mass, gyroscopic and stiffness matrices of elements in a row, (2 nodes, 2 nodes)."""
    size = 2 * (len(lengths) + 1)
    total = np.zeros((3, size, size))
    for i, length in enumerate(lengths):
        at = slice(2 * i, 2 * i + 4)
        total[:, at, at] += shaft.element(length)
    return total


@dataclass(frozen=True)
class Rotor:
    """The rotor kit, in SI units."""

    shaft: Shaft = field(default_factory=Shaft)
    span: float = 0.3801  # between the bearings
    overhang: float = 0.090  # on either side
    disc_mass: float = 0.8
    disc_radius: float = 0.0375
    disc_thickness: float = 0.025
    stiffness: float = 266e3  # of one bearing, at which the modal damping and the basis are taken
    damping_ratio: float = 0.05  # structural, of each mode
    speed: float = 2 * np.pi * 60  # 3600 rpm
    unbalance_radius: float = 0.030
    gap: float = -12e-6  # of the rubbing screw; negative: it presses on the resting shaft
    sampling: float = 8500.0
    settling: float = 0.4  # seconds before the record
    record: float = 0.2  # seconds
    modes: int = 6  # of the basis, besides static shapes

    # Nodes: 2 elements in an overhang, 8 in half a span.
    bearings = (2, 18)
    disc = 10
    contact = 12
    probe = 8

    def matrices(self):
        """Return mass, gyroscopic and stiffness matrices, and the bearings' pattern."""
        lengths = np.repeat([self.overhang / 2, self.span / 16, self.overhang / 2], [2, 16, 2])
        mass, gyro, stiffness = assemble(self.shaft, lengths)
        r = self.disc_radius
        h = self.disc_thickness
        at = 2 * self.disc
        mass[at, at] += self.disc_mass
        mass[at + 1, at + 1] += self.disc_mass * (3 * r**2 + h**2) / 12
        gyro[at + 1, at + 1] += self.disc_mass * r**2 / 2
        pattern = np.zeros_like(mass)
        for node in self.bearings:
            pattern[2 * node, 2 * node] = 1.0
        return mass, gyro, stiffness, pattern

    @cache  # noqa: B019 (frozen, and few)
    def reduced(self):
        """Return gyroscopic, damping, stiffness and bearing matrices in modes and static shapes.

        The lowest modes at the nominal bearing stiffness, and the static deflections under forces
        at the bearings and at the contact, made orthonormal in the mass matrix; and the rows of the
        basis at disc, contact and probe.
        """
        mass, gyro, stiffness, pattern = self.matrices()
        nominal = stiffness + self.stiffness * pattern
        _, vectors = eigh(nominal, mass, subset_by_index=[0, self.modes - 1])
        forces = np.eye(len(mass))[:, [2 * n for n in (*self.bearings, self.contact)]]
        basis = np.hstack([vectors, lu_solve(lu_factor(nominal), forces)])
        basis /= np.sqrt(np.einsum("ij,ik,kj->j", basis, mass, basis))
        values, rotation = eigh(basis.T @ nominal @ basis, basis.T @ mass @ basis)
        basis = basis @ rotation
        damping = np.diag(2 * self.damping_ratio * np.sqrt(values))
        bearing = basis.T @ pattern @ basis
        rows = basis[[2 * n for n in (self.disc, self.contact, self.probe)]]
        return (
            basis.T @ gyro @ basis,
            damping,
            np.diag(values) - self.stiffness * bearing,
            bearing,
            rows,
        )

    def state_matrix(self, k, c, speed):
        """Return the matrices of the state (deflection, velocity), shape (n, 2r, 2r), complex."""
        gyro, damping, stiffness, bearing, _ = self.reduced()
        k = k[:, None, None]
        c = c[:, None, None]
        r = len(gyro)
        a = np.zeros((len(k), 2 * r, 2 * r), dtype=complex)
        a[:, :r, r:] = np.eye(r)
        a[:, r:, :r] = -(stiffness + k * bearing)
        a[:, r:, r:] = -(damping + c * bearing) + 1j * speed * gyro
        return a


ROTOR = Rotor()


def first_frequency(k, c, rotor=ROTOR):
    """Return the first natural frequency in Hz, damped, at rest.

    ``k`` in kN/m and ``c`` in N s/m, of each bearing; NaN where the stiffness or damping is not
    positive.
    """
    k, c = np.broadcast_arrays(np.asarray(k, dtype=float), np.asarray(c, dtype=float))
    flat_k = k.ravel()
    flat_c = c.ravel()
    ok = (flat_k > 0) & (flat_c >= 0)
    found = np.full(k.size, np.nan)
    values = np.linalg.eigvals(rotor.state_matrix(1e3 * flat_k[ok], flat_c[ok], 0.0))
    frequency = np.where(values.imag > 1.0, values.imag, np.inf)
    found[ok] = frequency.min(axis=1) / (2 * np.pi)
    return found.reshape(k.shape)


def vibration(k, c, contact, unbalance=0.45, rotor=ROTOR, substeps=1):
    """Return the x-deflection at the probe in m under rub, shapes (n,) -> (n, samples).

    The linear rotor is propagated exactly in the coordinates of its complex modes; the contact
    force is linear in time over a step, and so small as to close the penalty law at its end.
    """
    a = rotor.state_matrix(1e3 * k, c, rotor.speed)
    r = a.shape[1] // 2
    disc, touch, probe = rotor.reduced()[-1]
    values, right = np.linalg.eig(a)
    left = np.linalg.inv(right)
    force = left[:, :, r:] @ touch  # of a unit force at the contact, (n, 2r)
    see = np.einsum("j,njk->nk", touch, right[:, :r]), np.einsum("j,njk->nk", probe, right[:, :r])
    dt = 1 / (rotor.sampling * substeps)
    z = values * dt
    step = np.exp(z)
    # Integrals of exp(lambda (dt - s)) against a force that falls from 1 to 0, and one that rises
    # from 0 to 1.
    rises = (step - 1 - z) / z**2 * dt
    falls = (step - 1) / z * dt - rises
    old = falls * force
    new = rises * force
    give = (see[0] * new).sum(axis=1).real  # deflection at the end of a step for a unit force there
    turning = 1e-3 * unbalance * rotor.unbalance_radius * rotor.speed**2
    whirl = (
        turning * (left[:, :, r:] @ disc) / (1j * rotor.speed - values)
    )  # the stationary answer to unbalance
    orbit = (see[0] * whirl).sum(axis=1), (see[1] * whirl).sum(axis=1)
    q = np.zeros_like(values)
    f = np.zeros(len(k))
    settle = round(rotor.settling * rotor.sampling)
    samples = round(rotor.record * rotor.sampling)
    found = np.empty((len(k), samples))
    soft = contact / (1 + contact * give)
    for i in range(1, (settle + samples) * substeps + 1):
        turn = np.exp(1j * rotor.speed * dt * i)
        q *= step
        q += old * f[:, None]
        free = np.einsum("nk,nk->n", see[0], q).real + (orbit[0] * turn).real
        f = -soft * np.maximum(free - rotor.gap, 0.0)
        q += new * f[:, None]
        at = i // substeps - settle - 1
        if at >= 0 and i % substeps == 0:
            found[:, at] = np.einsum("nk,nk->n", see[1], q).real + (orbit[1] * turn).real
    return found


def crest_factor(k, c, contact, unbalance=0.45, rotor=ROTOR, substeps=1):
    """Return peak over RMS of the vibration at the probe, about its mean.

    ``k`` in kN/m, ``c`` in N s/m, ``contact`` in MN/m, ``unbalance`` in g. NaN where one is not
    positive.
    """
    arrays = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (k, c, contact)))
    k, c, contact = (v.ravel() for v in arrays)
    ok = (k > 0) & (c >= 0) & (contact >= 0)
    found = np.full(k.size, np.nan)
    x = vibration(k[ok], c[ok], 1e6 * contact[ok], unbalance, rotor, substeps)
    x = x - x.mean(axis=1, keepdims=True)
    found[ok] = np.abs(x).max(axis=1) / np.sqrt((x**2).mean(axis=1))
    return found.reshape(arrays[0].shape)
