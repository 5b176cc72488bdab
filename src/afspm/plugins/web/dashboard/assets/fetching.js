// Requests to the dashboard: one at a time of each kind, and always the newest.

const QUIET_MS = 20000;
const isWatched = () => !document.hidden && document.hasFocus();

/**
 * A loop that fetches the newest picture; `show(head, bitmap)` draws a picture, `tell(text)` shows an error.
 *
 * A browser allows six connections to one server, for all its tabs together. So only the tab with the focus holds a
 * request open until a picture is new. Another tab that is seen asks when the page's own socket, which does not count,
 * says that one is new; a hidden tab asks for nothing.
 */
export class Pictures {
  constructor(show, tell) {
    Object.assign(this, { show, tell, asked: null, turn: 0, newest: 0, wake: null });
    const look = () => (isWatched() ? this.wake?.() : this.asked?.abort());
    document.addEventListener("visibilitychange", look);
    window.addEventListener("focus", look);
    window.addEventListener("blur", look);
  }

  /** Take the number of the newest picture. */
  hear(newest) {
    if (newest === this.newest) return;
    this.newest = newest;
    this.wake?.();
  }

  async #sleep(longest_ms) {
    await new Promise((done) => {
      this.wake = done;
      setTimeout(done, longest_ms);
    });
    this.wake = null;
  }

  /** Fetch pictures with these parameters of /live/image from now on. */
  want(query) {
    this.turn += 1;
    this.asked?.abort();
    this.wake?.();
    this.#follow(this.turn, query);
  }

  async #follow(turn, query) {
    let after = 0, wait = 0;
    while (turn === this.turn) {
      if (wait) await new Promise((done) => setTimeout(done, wait));
      while (document.hidden && turn === this.turn) await this.#sleep(QUIET_MS);
      if (turn !== this.turn) return;
      const heard = this.newest, patient = isWatched();
      this.asked = new AbortController();
      const late = setTimeout(() => this.asked.abort(), 30000);
      try {
        const answer = await fetch(`live/image?${new URLSearchParams({ ...query, after, patient })}`, { signal: this.asked.signal });
        if (answer.status === 401) window.location.reload();
        if (turn !== this.turn) return;
        if (answer.status === 200) {
          const head = JSON.parse(answer.headers.get("X-Frame"));
          const bitmap = await createImageBitmap(await answer.blob());
          if (turn !== this.turn) return;
          after = head.number;
          this.show(head, bitmap);
        } else if (answer.status !== 204) {
          this.tell(await answer.text());
        } else if (!patient && heard === this.newest) {
          await this.#sleep(QUIET_MS);
        }
        wait = 0;
        if (query.time) return; // a finished scan doesn't change
      } catch {
        if (turn !== this.turn) return;
        wait = isWatched() ? 1000 : 0; // the dashboard is not reachable; page.js shows the lost connection
      } finally {
        clearTimeout(late);
      }
    }
  }
}

/** A queue of JSON requests: while an answer is pending, only the newest further request is kept. */
export class Questions {
  constructor(path, answered) {
    Object.assign(this, { path, answered, next: null, busy: false });
  }

  async ask(query) {
    this.next = query;
    if (this.busy) return;
    this.busy = true;
    try {
      while (this.next) {
        const asked = this.next;
        this.next = null;
        const answer = await fetch(`${this.path}?${new URLSearchParams(asked)}`);
        if (answer.ok) this.answered(await answer.json(), asked);
      }
    } catch {
      this.next = null;
    } finally {
      this.busy = false;
    }
  }
}
