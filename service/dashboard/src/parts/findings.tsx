import type { Finding } from "../types";

const WORDS = { serious: "Serious", warning: "Warning", info: "Note" };

/** Findings in words, the worst first, each with its remedy. */
export function Findings({ findings }: { findings: Finding[] }) {
  if (findings.length === 0) return <p class="quiet">Nothing to remark.</p>;
  return (
    <ul class="findings">
      {findings.map((finding) => (
        <li key={`${finding.code} ${finding.where}`} class={finding.severity}>
          <span class="tag">{WORDS[finding.severity]}</span>
          <div>
            <p>{finding.message}</p>
            <p class="quiet">{finding.hint}</p>
          </div>
        </li>
      ))}
    </ul>
  );
}
