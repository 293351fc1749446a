import type { Problem } from "../api";

/** What went wrong, and what to do about it. */
export function ProblemNote({ problem }: { problem: Problem | null }) {
  if (!problem) return null;
  return (
    <p class="problem" role="alert">
      <strong>{problem.message}</strong> {problem.hint}
    </p>
  );
}
