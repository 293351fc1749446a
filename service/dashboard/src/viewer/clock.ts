// The moment that everything on the page shows.

import { effect, signal } from "@preact/signals";

export interface Meant {
  start_s: number;
  end_s: number;
  camera: string;
  joint: string;
}

export class Clock {
  readonly time_s = signal(0);
  readonly playing = signal(false);
  readonly speed = signal(1);
  /** What a finding speaks of, from the trial's first frame: marked until another one is shown. */
  readonly meant = signal<Meant | null>(null);

  constructor(
    readonly duration_s: number,
    readonly rate_hz: number,
  ) {
    let last = 0;
    const step = (now: number) => {
      if (!this.playing.value) return;
      const next = this.time_s.value + (this.speed.value * (now - last)) / 1000;
      last = now;
      this.time_s.value = next > duration_s ? 0 : next;
      requestAnimationFrame(step);
    };
    effect(() => {
      if (!this.playing.value) return;
      last = performance.now();
      requestAnimationFrame(step);
    });
  }

  seek(time_s: number) {
    this.time_s.value = Math.min(Math.max(time_s, 0), this.duration_s);
  }

  /** Go to a moment and mark what is meant. */
  show(meant: Meant) {
    this.playing.value = false;
    this.meant.value = meant;
    this.seek(meant.start_s);
  }

  stepBy(frames: number) {
    this.playing.value = false;
    this.seek((Math.round(this.time_s.value * this.rate_hz) + frames) / this.rate_hz);
  }

  toggle() {
    this.playing.value = !this.playing.value;
  }
}
