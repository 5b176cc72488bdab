"""Which connection owns a name: restarts, losses of connection, impostors."""

from __future__ import annotations

from tests.unit.scheduler.core_parts import Held

from afspm.model.sessions import Hearing, SessionTable, token_of

ACCEPTED, TAKEN, STALE, UNCLEAR = Hearing.ACCEPTED, Hearing.TAKEN, Hearing.STALE, Hearing.UNCLEAR


def test_token_is_read_only_from_ids_of_the_usual_form() -> None:
    assert token_of("exp", "exp/a1/7") == "a1"
    assert token_of("exp", "exp/a1/7/2") == "a1"
    assert token_of("exp", "exp/key/7/2") is None
    assert token_of("exp", "exp/key/tile") is None
    assert token_of("exp", "other/a1/7") is None
    assert token_of("exp", "exp/step-17/1/start") is None
    assert token_of("exp", "my-key") is None


def test_a_restarted_component_is_the_same_client() -> None:
    sessions = Held(SessionTable())
    sessions.connected(1)
    assert sessions.hear(1, "exp", "exp/a/1", 0.0) is ACCEPTED
    assert sessions.disconnected(1, 1.0) == "exp"
    assert sessions.lost_since_s("exp") == 1.0
    sessions.connected(2)
    assert sessions.hear(2, "exp", "exp/b/1", 1.2) is ACCEPTED
    assert (sessions.connection_of("exp"), sessions.lost_since_s("exp")) == (2, None)


def test_second_live_process_of_a_name_is_refused() -> None:
    sessions = Held(SessionTable())
    for connection in (1, 2):
        sessions.connected(connection)
    assert sessions.hear(1, "exp", "exp/a/1", 0.0) is ACCEPTED
    assert sessions.hear(2, "exp", "exp/b/1", 0.1) is TAKEN
    assert sessions.hear(1, "exp", "exp/a/2", 0.2) is ACCEPTED


def test_handing_the_name_over_does_not_make_the_impostor_its_owner() -> None:
    """ROUTER closes the owner's connection when the impostor connects; then the owner reconnects, and so on."""
    sessions = Held(SessionTable(takeover_s=3.0))
    sessions.connected(1)
    assert sessions.hear(1, "exp", "exp/a/1", 0.0) is ACCEPTED
    sessions.connected(2)
    sessions.disconnected(1, 1.0)
    assert sessions.hear(2, "exp", "exp/b/1", 1.0) is TAKEN
    sessions.connected(3)
    sessions.disconnected(2, 1.1)
    assert sessions.hear(3, "exp", "exp/a/2", 1.1) is ACCEPTED
    sessions.connected(4)
    sessions.disconnected(3, 1.2)
    assert sessions.hear(4, "exp", "exp/b/1", 1.2) is TAKEN


def test_reconnecting_peer_without_ids_is_the_same_client_in_either_order() -> None:
    sessions = Held(SessionTable())
    sessions.connected(1)
    assert sessions.hear(1, "old", "", 0.0) is ACCEPTED
    sessions.connected(2)
    assert sessions.hear(2, "old", "", 1.0) is UNCLEAR
    sessions.disconnected(1, 1.001)
    assert sessions.hear(2, "old", "", 1.002) is ACCEPTED


def test_peer_without_ids_does_not_take_the_name_of_a_peer_with_ids() -> None:
    sessions = Held(SessionTable(takeover_s=3.0))
    sessions.connected(1)
    assert sessions.hear(1, "exp", "exp/a/1", 0.0) is ACCEPTED
    sessions.connected(2)
    assert sessions.hear(2, "exp", "", 1.0) is TAKEN
    sessions.disconnected(1, 1.1)
    assert sessions.hear(2, "exp", "", 1.2) is TAKEN


def test_a_name_whose_owner_never_comes_back_is_free_in_the_end() -> None:
    """Its connection had died unnoticed, so its restarted process looked like an impostor."""
    sessions = Held(SessionTable(takeover_s=3.0))
    sessions.connected(1)
    sessions.hear(1, "exp", "exp/a/1", 0.0)
    sessions.connected(2)
    sessions.disconnected(1, 1.0)
    assert sessions.hear(2, "exp", "exp/b/1", 3.9) is TAKEN
    assert sessions.hear(2, "exp", "exp/b/2", 4.0) is ACCEPTED


def test_presumed_dead_client_regains_its_name() -> None:
    sessions = Held(SessionTable())
    sessions.connected(1)
    sessions.hear(1, "exp", "exp/a/1", 0.0)
    sessions.disconnected(1, 1.0)
    sessions.connected(2)
    assert sessions.hear(2, "exp", "exp/b/1", 1.1) is ACCEPTED
    sessions.connected(3)
    assert sessions.hear(3, "exp", "exp/a/2", 1.2) is ACCEPTED
    assert sessions.hear(2, "exp", "exp/b/2", 1.3) is TAKEN


def test_presumed_dead_client_regains_its_name_from_silent_connections() -> None:
    sessions = Held(SessionTable())
    sessions.connected(1)
    sessions.hear(1, "exp", "exp/a/1", 0.0)
    for connection in (2, 3, 4):
        sessions.disconnected(connection - 1, float(connection))
        sessions.connected(connection)
        assert sessions.hear(connection, "exp", None, float(connection)) is ACCEPTED
    sessions.connected(5)
    assert sessions.hear(5, "exp", "exp/a/2", 5.0) is ACCEPTED


def test_message_of_a_closed_connection_is_stale() -> None:
    sessions = Held(SessionTable())
    sessions.connected(1)
    sessions.hear(1, "exp", "exp/a/1", 0.0)
    sessions.disconnected(1, 1.0)
    assert sessions.hear(1, "exp", "exp/a/2", 1.1) is STALE


def test_silent_connection_has_no_name() -> None:
    sessions = Held(SessionTable())
    sessions.connected(1)
    sessions.hear(1, "exp", "exp/a/1", 0.0)
    sessions.disconnected(1, 1.0)
    sessions.connected(2)
    assert (sessions.connection_of("exp"), sessions.lost_since_s("exp")) == (None, 1.0)


def test_owner_regains_its_name_over_a_restart_of_the_scheduler() -> None:
    before = Held(SessionTable())
    before.connected(1)
    before.hear(1, "exp", "exp/a/1", 0.0)
    sessions = Held(SessionTable())
    sessions.restored(before.tokens())
    for connection in (1, 2):
        sessions.connected(connection)
    assert sessions.hear(1, "exp", "exp/b/1", 0.0) is ACCEPTED  # it may as well be the restarted one
    assert sessions.hear(2, "exp", "exp/a/9", 0.1) is ACCEPTED
    assert sessions.hear(1, "exp", "exp/b/2", 0.2) is TAKEN


def test_number_of_remembered_names_is_bounded() -> None:
    sessions = Held(SessionTable(keep=10))
    for n in range(1000):
        sessions.connected(n)
        sessions.hear(n, f"peer-{n}", "", 0.0)
        sessions.disconnected(n, 0.0)
    assert len(sessions.names) <= 11
    assert sessions.opened == {}
    assert sessions.name_of == {}
