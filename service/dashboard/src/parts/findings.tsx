import type { Finding } from "../types";

const WORDS = { serious: "Serious", warning: "Warning", info: "Note" };

interface Props {
  findings: Finding[];
  /** Shows the moment that a finding speaks of, where there is something to show. */
  onMoment?: (finding: Finding) => void;
}

/** Findings in words, the worst first, each with its remedy and the way to its moment. */
export function Findings({ findings, onMoment }: Props) {
  if (findings.length === 0) return <p class="quiet">Nothing to remark.</p>;
  return (
    <ul class="findings">
      {findings.map((finding) => (
        <li key={`${finding.code} ${finding.where} ${finding.start_s}`} class={finding.severity}>
          <span class="tag">{WORDS[finding.severity]}</span>
          <div>
            <p>
              {finding.message}{" "}
              {onMoment && finding.start_s != null && (
                <button class="moment" onClick={() => onMoment(finding)}>
                  Show it {when(finding.start_s, finding.end_s ?? finding.start_s)}
                </button>
              )}
            </p>
            <p class="quiet">{finding.hint}</p>
          </div>
        </li>
      ))}
    </ul>
  );
}

/** As the printed report has it. */
function when(start_s: number, end_s: number): string {
  const [start, end] = [start_s.toFixed(1), end_s.toFixed(1)];
  return start === end ? `at ${start} s` : `from ${start} s to ${end} s`;
}
