import { useEffect } from "preact/hooks";
import type { Clock } from "./clock";

const SPEEDS = [0.1, 0.25, 0.5, 1];

/** Play, step, scrub; also by keyboard: space, arrows, Home and End. */
export function Transport({ clock }: { clock: Clock }) {
  useEffect(() => {
    const keys: Record<string, () => void> = {
      " ": () => clock.toggle(),
      ArrowLeft: () => clock.stepBy(-1),
      ArrowRight: () => clock.stepBy(1),
      Home: () => clock.seek(0),
      End: () => clock.seek(clock.duration_s),
    };
    const press = (event: KeyboardEvent) => {
      // A field has its own use for keys; a button only for the space bar.
      const taken = event.key === " " ? "input, select, textarea, button, a, summary" : "input, select, textarea";
      const typing = (event.target as HTMLElement).closest(taken);
      const act = keys[event.key];
      if (!act || typing || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      act();
    };
    addEventListener("keydown", press);
    return () => {
      clock.playing.value = false;
      removeEventListener("keydown", press);
    };
  }, [clock]);
  const time = clock.time_s.value;
  return (
    <div class="transport" role="group" aria-label="Time">
      <button onClick={() => clock.toggle()} aria-label={clock.playing.value ? "Pause" : "Play"}>
        {clock.playing.value ? "❚❚" : "▶"}
      </button>
      <button onClick={() => clock.stepBy(-1)} aria-label="One frame back">
        ‹
      </button>
      <button onClick={() => clock.stepBy(1)} aria-label="One frame on">
        ›
      </button>
      <input
        type="range"
        min={0}
        max={clock.duration_s}
        step={1 / clock.rate_hz}
        value={time}
        aria-label="Moment"
        aria-valuetext={`${time.toFixed(2)} seconds`}
        onInput={(event) => {
          clock.playing.value = false;
          clock.seek(Number(event.currentTarget.value));
        }}
      />
      <output>
        {time.toFixed(2)} / {clock.duration_s.toFixed(2)} s
      </output>
      <select aria-label="Speed" value={clock.speed.value} onChange={(event) => (clock.speed.value = Number(event.currentTarget.value))}>
        {SPEEDS.map((speed) => (
          <option key={speed} value={speed}>
            {speed}×
          </option>
        ))}
      </select>
    </div>
  );
}
