import time
from math import comb

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from adjust.relay import loops as loops_module
from adjust.relay.counts import count
from adjust.relay.loops import loop_basis
from adjust.relay.network import topology
from tests.adjust.relay_networks import complete, ends, grid


def simple_cycles(top):
    """All loops of a small network as sets of pairs, by walking everywhere."""
    ways = [[] for _ in range(top.n_stations)]
    for e, (a, b) in enumerate(zip(top.a_idx, top.b_idx, strict=True)):
        ways[a].append((b, e))
        ways[b].append((a, e))
    found = set()

    def walk(start, v, seen, path):
        for w, e in ways[v]:
            if w == start and path and e not in path:
                found.add(frozenset([*path, e]))
            elif w > start and w not in seen:
                walk(start, w, seen | {w}, [*path, e])

    for start in range(top.n_stations):
        walk(start, start, {start}, [])
    return found


def rank_and_length(cycles):
    """Rank over GF(2), and total length of the independent ones taken shortest first, with integers as bit sets."""
    pivots, length = {}, 0
    for cycle in sorted(cycles, key=len):
        bits = sum(1 << int(e) for e in cycle)
        while bits and bits.bit_length() in pivots:
            bits ^= pivots[bits.bit_length()]
        if bits:
            pivots[bits.bit_length()] = bits
            length += len(cycle)
    return len(pivots), length


def random_networks(n_networks, seed):
    rng = np.random.default_rng(seed)
    for _ in range(n_networks):
        n = int(rng.integers(3, 9))
        m = int(rng.integers(2, min(15, 2 * n + 2)))
        ends = [rng.choice(n, 2, replace=False) for _ in range(m)]
        yield topology([(f"p{e}", str(a), str(b)) for e, (a, b) in enumerate(ends)], [str(i) for i in range(n)])


@pytest.mark.parametrize("n", [3, 4, 5, 12, 40])
def test_theorem_1(n):
    counts = count(complete(n))
    assert counts.independent_unknowns == n - 1
    assert counts.measurable_pairs == counts.n_pairs == comb(n, 2)
    assert counts.triangle_conditions == comb(n, 3)
    assert counts.independent_conditions == comb(n - 1, 2)
    assert counts.redundancy == 3 * comb(n - 1, 2)
    assert counts.conditions_per_unknown == pytest.approx((n - 2) / n)
    assert not counts.uncontrolled_pairs
    assert count(complete(n), 6).redundancy == 6 * comb(n - 1, 2)


def test_any_network_against_all_its_loops():
    for top in random_networks(150, seed=0):
        counts, cycles = count(top), simple_cycles(top)
        assert counts.independent_conditions == rank_and_length(cycles)[0]
        in_loops = {e: frozenset(c for c in cycles if e in c) for e in range(top.n_pairs)}
        assert set(counts.uncontrolled_pairs) == {top.pair_ids[e] for e, c in in_loops.items() if not c}
        together = {}
        for e, loops in in_loops.items():
            together.setdefault(loops, []).append(top.pair_ids[e])
        expected = {tuple(ids) for loops, ids in together.items() if loops and len(ids) > 1}
        assert set(counts.inseparable_pairs) == expected
        triples = {frozenset(map(int, np.r_[top.a_idx[list(c)], top.b_idx[list(c)]])) for c in cycles if len(c) == 3}
        assert counts.triangle_conditions == len(triples)


def test_shortest_loops_against_all_loops():
    for top in random_networks(150, seed=1):
        rank, shortest = rank_and_length(simple_cycles(top))
        for basis in (loop_basis(top), loop_basis(top, "tree"), loop_basis(top, budget=30)):
            sets = [frozenset(basis.pair_idx[basis.ptr[k] : basis.ptr[k + 1]].tolist()) for k in range(len(basis))]
            assert len(sets) == rank == rank_and_length(sets)[0]
            if basis.minimal:
                assert basis.lengths.sum() == shortest
        assert loop_basis(top).minimal or rank == 0


def through_every_station(top):
    """Of every station and pair the loop of the shortest ways from the station to the pair's ends: sets of pairs."""
    ways = [[] for _ in range(top.n_stations)]
    for e, (a, b) in enumerate(zip(top.a_idx.tolist(), top.b_idx.tolist(), strict=True)):
        ways[a].append((b, e))
        ways[b].append((a, e))
    found = set()
    for start in range(top.n_stations):
        to, front = {start: frozenset()}, [start]
        for v in front:
            for w, e in ways[v]:
                if w not in to:
                    to[w] = to[v] | {e}
                    front.append(w)
        for e, (a, b) in enumerate(zip(top.a_idx.tolist(), top.b_idx.tolist(), strict=True)):
            if a in to and e not in to[a] | to[b]:
                found.add(to[a] ^ to[b] ^ {e})
    return found


def far_apart(n, m, seed):
    """Pairs between near stations and a few across, in a ring: some loops are short, the others of every length."""
    rng = np.random.default_rng(seed)
    rows = [(i, (i + 1) % n) for i in range(n)]
    rows += [(int(i), int(i + rng.integers(1, 5)) % n) for i in rng.integers(0, n, m)]
    rows += [tuple(rng.choice(n, 2, replace=False).tolist()) for _ in range(6)]
    return topology([(f"p{e}", str(a), str(b)) for e, (a, b) in enumerate(rows)], [str(i) for i in range(n)])


@pytest.mark.parametrize(("n", "m"), [(40, 20), (60, 90), (50, 150), (150, 120)])
def test_many_loops_are_as_short_as_those_through_every_station(n, m):
    for seed in range(3):
        top = far_apart(n, m, seed)
        rank, shortest = rank_and_length(through_every_station(top))
        basis = loop_basis(top)
        sets = [frozenset(basis.pair_idx[basis.ptr[k] : basis.ptr[k + 1]].tolist()) for k in range(len(basis))]
        assert basis.minimal
        assert len(sets) == rank == rank_and_length(sets)[0]
        assert basis.lengths.sum() == shortest


def test_the_way_round_a_cylinder_is_found_within_the_budget():
    n, rings = 80, 25
    rows = [(f"r{i},{k}", f"{i},{k}", f"{(i + 1) % n},{k}") for i in range(n) for k in range(rings)]
    rows += [(f"u{i},{k}", f"{i},{k}", f"{i},{k + 1}") for i in range(n) for k in range(rings - 1)]
    basis = loop_basis(topology(rows), budget=2_000_000)
    assert basis.minimal
    assert sorted(basis.lengths.tolist()) == [4] * n * (rings - 1) + [n]


def test_loops_are_walks():
    top = grid(5, 4)
    basis = loop_basis(top)
    assert set(basis.lengths) == {4}
    for k in range(len(basis)):
        stations = basis.stations(k)
        for pair, a, b in zip(basis.pairs(k), stations, stations[1:] + stations[:1], strict=True):
            assert set(ends(top, top.pair_ids.index(pair))) == {a, b}


def test_grid_of_4900_loops_has_its_faces_as_basis_in_seconds():
    top = grid(71, 71)
    start = time.process_time()
    basis = loop_basis(top)
    # 0.1 s measured alone
    assert time.process_time() - start < 20.0
    assert basis.minimal
    assert (len(basis), basis.lengths.max()) == (4900, 4)


def test_search_that_runs_out_says_so():
    basis = loop_basis(grid(30, 30), budget=20_000)
    assert not basis.minimal
    assert "used up its budget" in basis.note
    assert len(basis) == 29 * 29


def test_loops_that_are_too_many_for_the_shortest_are_short_and_independent(monkeypatch):
    monkeypatch.setattr(loops_module, "MAX_SHORTEST_LOOPS", 10)
    ladder = loop_basis(grid(2, 400))
    assert (len(ladder), set(ladder.lengths.tolist())) == (399, {4})
    assert "too many" in ladder.note
    for top, seen in ((far_apart(60, 90, 1), 200), (far_apart(60, 90, 1), 8), (grid(12, 9), 200)):
        monkeypatch.setattr(loops_module, "_SEEN", seen)
        basis = loop_basis(top)
        sets = [frozenset(basis.pair_idx[basis.ptr[k] : basis.ptr[k + 1]].tolist()) for k in range(len(basis))]
        rank, shortest = rank_and_length(through_every_station(top))
        assert len(sets) == rank == rank_and_length(sets)[0]
        assert ("of a spanning tree" in basis.note) == (seen == 8)
        assert seen == 8 or basis.lengths.sum() < 1.3 * shortest


def test_text_names_parts_and_uncontrolled_pairs():
    rows = [("ab", "A", "B"), ("bc", "B", "C"), ("ca", "C", "A"), ("cd", "C", "D"), ("xy", "X", "Y")]
    counts = count(topology(rows, ("A", "B", "Z")), 6)
    assert counts.parts == (("A", "B", "C", "D"), ("X", "Y"), ("Z",))
    assert counts.uncontrolled_pairs == ("cd", "xy")
    assert counts.isolated_stations == ("Z",)
    assert (counts.independent_unknowns, counts.redundancy) == (4, 6)
    text = str(counts)
    assert "part 2: X, Y" in text
    assert "uncontrolled (close no loop): cd, xy" in text
    assert "not told apart: ab, bc, ca" in text


def test_pair_measured_twice_is_a_loop_of_two():
    top = topology([("first", "A", "B"), ("second", "B", "A")])
    basis = loop_basis(top)
    assert basis.pairs(0) in (("first", "second"), ("second", "first"))
    assert count(top).independent_conditions == 1
    assert count(top).measurable_pairs == 1


@pytest.mark.slow
def test_hundred_thousand_stations_take_about_a_second():
    n = 100_000
    rng = np.random.default_rng(0)
    rows = [(f"t{i}", str(i), str(int(rng.integers(0, i)))) for i in range(1, n)]
    rows += [(f"c{i}", str(i), str((i * 7919 + 13) % n)) for i in range(0, n, 2)]
    top = topology(rows)
    start = time.process_time()
    counts = count(top)
    assert time.process_time() - start < 5.0
    assert counts.independent_conditions == len(rows) - n + 1


@pytest.mark.parametrize(
    ("rows", "stations", "message"),
    [
        ([("p", "A", "B"), ("p", "B", "C")], (), "pair 'p' is there twice"),
        ([("p", "A", "A")], (), "pair 'p' joins 'A' with itself"),
        ([("p", "A", "B")], ("A", "A"), "station 'A' is there twice"),
    ],
)
def test_wrong_rows(rows, stations, message):
    with pytest.raises(SurveyError, match=message):
        topology(rows, stations)
