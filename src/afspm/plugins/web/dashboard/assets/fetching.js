// Requests to the dashboard: one at a time of each kind, and always the newest.

/** A loop that fetches the newest picture; `show(head, bitmap)` draws a picture, `tell(text)` shows an error. */
export class Pictures {
  constructor(show, tell) {
    Object.assign(this, { show, tell, asked: null, turn: 0 });
  }

  /** Fetch pictures with these parameters of /live/image from now on. */
  want(query) {
    this.turn += 1;
    this.asked?.abort();
    this.#follow(this.turn, query);
  }

  async #follow(turn, query) {
    let after = 0, wait = 0;
    while (turn === this.turn) {
      if (wait) await new Promise((done) => setTimeout(done, wait));
      if (turn !== this.turn) return;
      this.asked = new AbortController();
      const late = setTimeout(() => this.asked.abort(), 30000);
      try {
        const answer = await fetch(`/live/image?${new URLSearchParams({ ...query, after })}`, { signal: this.asked.signal });
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
        }
        wait = 0;
        if (query.time) return; // a finished scan doesn't change
      } catch {
        if (turn !== this.turn) return;
        wait = 1000; // the dashboard is not reachable; page.js shows the lost connection
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
