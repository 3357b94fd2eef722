# SPDX-License-Identifier: Apache-2.0
"""Riders: they sit on the saddle, hold the grips and stand on the pedals, on every machine, at human size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from edge.frames import Float64
from train.objects.contacts import find_contacts
from train.objects.human import HumanModel
from train.objects.human_rider import human_rider
from train.objects.mesh import CLASSES, ClassName, Mesh, MeshError, stand
from train.objects.parametric import RIDER_SHARE, generate, two_wheeler
from train.objects.parametric_person import Body
from train.objects.primitives import Part, join
from train.objects.reduce import merge_near, reduce_to
from train.objects.reference import HUMAN_FILE, ObjectRef, library_refs
from train.objects.rider import Contacts, Skeleton, fit_stature, own_rider, settle, trunk_lean
from train.objects.sampling import sample_surface

RIDDEN: tuple[ClassName, ...] = ("bicycle", "motorcycle")


def touch_m(parts: list[Part], contacts: Contacts) -> Float64:
    """Distance of the rider's surface from the saddle, both grips and both foot rests."""
    vertices, faces = join(parts)
    surface = cKDTree(sample_surface(vertices, faces, 40_000, np.random.default_rng(0)))
    return np.asarray(surface.query(np.vstack([contacts.saddle, contacts.grips, contacts.feet]))[0])


@pytest.mark.parametrize("name", RIDDEN)
def test_own_riders_touch_saddle_grips_and_rests(name: ClassName) -> None:
    for seed in range(15):
        _, contacts = two_wheeler(name, seed)
        away = touch_m(own_rider(contacts, np.random.default_rng(seed)), contacts)
        assert away.max() < 0.05, (name, seed, away)


@pytest.mark.parametrize("name", RIDDEN)
def test_riders_of_the_human_model_touch_too(name: ClassName, object_data: Path) -> None:
    if not (object_data / HUMAN_FILE).is_file():
        pytest.skip("no human model here")
    model = HumanModel.load(object_data / HUMAN_FILE)
    for seed in range(6):
        _, contacts = two_wheeler(name, seed)
        parts = human_rider(model, contacts, np.random.default_rng(seed))
        assert touch_m(parts, contacts).max() < 0.05, (name, seed)
        vertices, faces = join(parts)
        assert 4_000 < len(faces) < 15_000
        assert 0.9 < np.ptp(vertices[:, 2]) < 2.0


def test_the_bare_machine_is_where_its_rider_touches_it() -> None:
    """The contacts lie on the machine's own surface."""
    for name in RIDDEN:
        for seed in range(10):
            parts, contacts = two_wheeler(name, seed)
            assert touch_m(parts, contacts).max() < 0.05, (name, seed)


def test_library_two_wheelers_can_be_ridden(object_data: Path) -> None:
    """All of them; saddle and grips are found on the machine itself, and the rider touches them."""
    checked = 0
    for ref in library_refs(object_data):
        if ref.class_name not in RIDDEN:
            continue
        mesh = ref.mesh(object_data)
        contacts = find_contacts(mesh)
        machine = cKDTree(sample_surface(mesh.vertices, mesh.faces, 60_000, np.random.default_rng(1)))
        assert machine.query(np.vstack([contacts.saddle, contacts.grips]))[0].max() < 0.06, ref.name
        checked += 1
        if checked % 6 == 0:
            away = touch_m(own_rider(contacts, np.random.default_rng(0)), contacts)
            assert away[:3].max() < 0.05, (ref.name, away)
    assert checked >= 70


def test_half_of_the_parametric_two_wheelers_are_ridden() -> None:
    for name in RIDDEN:
        ridden = [len(generate(name, seed).faces) > len(join(two_wheeler(name, seed)[0])[1]) for seed in range(40)]
        assert np.mean(ridden) == pytest.approx(RIDER_SHARE, abs=0.22)
        bare, tall = (float(generate(name, 0, rider=rider).size_m[2]) for rider in (False, True))
        assert bare + 0.2 < tall > 1.4


def test_a_named_rider_sits_on_the_named_machine(object_data: Path) -> None:
    bare, ridden = (ObjectRef.from_text(t) for t in ("bicycle/dcl_city", "bicycle/dcl_city@rider3"))
    first, again, leaned = ridden.mesh(), ridden.mesh(), ObjectRef.from_text("bicycle/dcl_city@rider3+5").mesh()
    np.testing.assert_array_equal(first.vertices, again.vertices)
    assert first.size_m[2] > bare.mesh().size_m[2] + 0.4
    assert len(leaned.vertices) == len(first.vertices)  # machine and rider lean together
    assert (first.object_id, first.source_group) == ("bicycle/dcl_city@rider3", bare.source_group)
    assert ridden.split == bare.split
    other = ObjectRef.from_text("bicycle/dcl_city@rider4").mesh()
    assert other.vertices.shape != first.vertices.shape or not np.allclose(other.vertices, first.vertices)
    if (object_data / HUMAN_FILE).is_file():
        assert len(ObjectRef.from_text("bicycle/dcl_city@human3").mesh().faces) > len(first.faces)


@pytest.mark.parametrize("text", ["car/parametric_00001@rider1", "bicycle/parametric_00001@dog1", "bicycle/x@rider"])
def test_riders_that_cannot_be(text: str) -> None:
    with pytest.raises(MeshError):
        ObjectRef.from_text(text)


def test_what_has_no_saddle_is_not_ridden() -> None:
    with pytest.raises(MeshError, match="two-wheelers"):
        find_contacts(generate("car", 0))
    vertices, faces = join([two_wheeler("bicycle", 0)[0][0]])  # one wheel
    with pytest.raises(MeshError):
        find_contacts(Mesh(stand(vertices), faces, CLASSES.index("bicycle"), "bicycle/wheel"))


def test_trunk_leans_as_far_as_the_arms_need() -> None:
    """Closed form: with the grips level with the hips, d^2 = (x - t sin a)^2 + (t cos a)^2 gives the lean a."""
    skeleton = Skeleton.of(Body(1.75, 1.0, 0.01))
    grips = np.array([[0.7, skeleton.shoulder, 0.0], [0.7, -skeleton.shoulder, 0.0]])
    contacts = Contacts(np.zeros(3), grips, np.zeros((2, 3)), True, 0.9)
    arm, t = 0.9 * (skeleton.upper_arm + skeleton.forearm), skeleton.torso
    expected = np.arcsin((0.7**2 + t**2 - arm**2) / (2 * 0.7 * t))
    assert trunk_lean(contacts, skeleton, np.zeros(3)) == pytest.approx(expected, abs=np.radians(1.01))


def test_stature_follows_the_saddle() -> None:
    """A child on a child's bicycle, a tall rider on a high saddle."""
    feet = np.array([[0.2, 0.12, 0.1], [0.3, -0.12, 0.4]])
    grips = np.array([[0.6, 0.3, 0.9], [0.6, -0.3, 0.9]])
    low, high = (Contacts(np.array([0, 0, z]), grips, feet, True) for z in (0.62, 1.0))
    assert fit_stature(low, 1.75) < 1.5 < 1.7 < fit_stature(high, 1.5)
    assert fit_stature(Contacts(np.array([0, 0, 0.62]), grips, feet, False), 1.75) == 1.75  # pegs: legs just bend


def test_settling_puts_the_lowest_point_of_the_trunk_just_into_the_saddle() -> None:
    contacts = Contacts(np.array([0.1, 0, 0.9]), np.zeros((2, 3)), np.zeros((2, 3)), True)
    ball = np.random.default_rng(0).normal(size=(4000, 3))
    ball = 0.15 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    pelvis = settle(contacts, 1.75, lambda place: place + ball)
    assert pelvis[2] == pytest.approx(0.9 + 0.15 - 0.015, abs=0.005)


def test_merging_moves_no_vertex_farther_than_a_cell() -> None:
    mesh = generate("pedestrian", 1)
    vertices, faces = mesh.vertices, mesh.faces
    merged, kept = merge_near(vertices.astype(float), faces.astype(np.int64), 0.05)
    assert 0 < len(kept) < len(faces)
    assert cKDTree(vertices).query(merged)[0].max() < 0.05 * np.sqrt(3)
    assert all(len(set(face)) == 3 for face in kept.tolist())
    _, fewer = reduce_to(vertices.astype(float), faces.astype(np.int64), 200)
    assert 100 < len(fewer) <= 200
    same, _ = reduce_to(vertices.astype(float), faces.astype(np.int64), len(faces))
    np.testing.assert_array_equal(same, vertices)
