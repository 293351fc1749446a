// Ask the service for something and keep asking while it changes.

import { useEffect, useState } from "preact/hooks";
import { Problem } from "./api";

export interface Loaded<T> {
  value: T | null;
  problem: Problem | null;
  again: () => void;
}

/** Load `ask()` now, whenever `key` changes, and every `everyMs` milliseconds as long as `keepOn` wants it. */
export function useLoaded<T>(ask: () => Promise<T>, key: string, keepOn?: (value: T) => boolean, everyMs = 1000): Loaded<T> {
  const [value, setValue] = useState<T | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [round, setRound] = useState(0);
  useEffect(() => {
    let current = true;
    let timer: ReturnType<typeof setTimeout> | undefined;
    const load = () =>
      ask().then(
        (found) => {
          if (!current) return;
          setValue(found);
          setProblem(null);
          if (keepOn?.(found)) timer = setTimeout(load, everyMs);
        },
        (error: unknown) => {
          if (!current) return;
          if (!(error instanceof Problem)) throw error;
          setProblem(error);
          // A service that was restarted comes back: what is shown stays, and the page asks again.
          if (error.status === 0 || error.status >= 500) timer = setTimeout(load, 2 * everyMs);
        },
      );
    load();
    return () => {
      current = false;
      clearTimeout(timer);
    };
  }, [key, round]);
  return { value, problem, again: () => setRound((n) => n + 1) };
}
