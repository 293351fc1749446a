import type { Finding } from "../types";

const WORDS = { serious: "Serious", warning: "Warning", info: "Note" };

interface Props {
  findings: Finding[];
  /** Shows the moment that a finding speaks of, where there is something to show. */
  onMoment?: (finding: Finding) => void;
}

const RANK = { serious: 0, warning: 1, info: 2 };

/** The worst first; what has the same remedy, as six cameras with one fault, stands together. */
function groupsOf(findings: Finding[]): Finding[][] {
  const groups = new Map<string, Finding[]>();
  for (const finding of [...findings].sort((a, b) => RANK[a.severity] - RANK[b.severity])) {
    const key = `${finding.severity} ${finding.hint}`;
    groups.set(key, [...(groups.get(key) ?? []), finding]);
  }
  return [...groups.values()];
}

/** Findings in words, the worst first, each with its remedy and the way to its moment. */
export function Findings({ findings, onMoment }: Props) {
  if (findings.length === 0) return <p class="quiet">Nothing to remark.</p>;
  return (
    <ul class="findings">
      {groupsOf(findings).map((group) => (
        <li key={`${group[0]!.severity} ${group[0]!.hint}`} class={group[0]!.severity}>
          <span class="tag">{WORDS[group[0]!.severity]}</span>
          <div>
            {group.map((finding) => (
              <p key={`${finding.code} ${finding.where} ${finding.start_s}`}>
                {finding.message}{" "}
                {onMoment && finding.start_s != null && (
                  <button class="moment" onClick={() => onMoment(finding)}>
                    Show it {when(finding.start_s, finding.end_s ?? finding.start_s)}
                  </button>
                )}
              </p>
            ))}
            <p class="quiet">{group[0]!.hint}</p>
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
