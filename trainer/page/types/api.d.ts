/** What the server's calls take and give, as far as the page reads it. */

interface Owner { name: string; project?: string | null }
interface Progress { done: number; total: number; unit: string; metrics: Record<string, number> }
interface Stage {
  name: string; kind: string; state: string; key: string | null;
  outputs: Record<string, string>; metrics: Record<string, number>; progress: Progress;
  wall_s: number; peak_memory?: number; attempt: number; workers: string[]; instruction_set?: string; message: string | null;
  wants_workers?: number; of?: string; needs?: string[]; times?: Times;
}
interface Times { created_ms?: number; started_ms?: number; ended_ms?: number }
interface Change { path: string; from: unknown; to: unknown }
/** Why a stage was computed, in the server's words. */
interface Why { kind: string; changes?: Change[]; inputs?: string[]; text: string }
interface SettingsOfStage { stage: string; settings: Record<string, unknown>; code: number; key?: string; from?: string; why?: Why }
interface RunSettings { run: string; previous: string | null; missing?: string[]; seed: number; source: string; stages: SettingsOfStage[] }
interface HistoryRow {
  id: number; at_ms: number; kind: string; run?: string; stage?: string; task?: string; attempt?: number; step?: number;
  worker?: string; model?: string; actor?: string; why?: string;
}
interface Trial { trial: number; values: Record<string, unknown>; state: string; steps: number; results: (number | null)[]; message?: string }
interface Sweep { stage: string; search: string; metric: string; mode: string; rungs: number[]; over: boolean; spent: number; planned: number; full: number; best: number | null; trials: Trial[] }
interface Run {
  run: string; pipeline: string; owner: Owner; state: string; interrupted: boolean; queued?: boolean; stages: Stage[];
  note?: string; sweeps?: Sweep[]; storage?: { since_ms: number; what: string }; times?: Times;
}
/** A run in a list. */
interface RunRow {
  run: string; pipeline: string; owner?: string; project?: string; state: string; interrupted?: boolean; queued?: boolean;
  created_ms: number; changed_ms: number; done: number; stages: number; wall_s: number; wants_workers?: number; note?: string;
}
interface RunList { items: RunRow[]; next?: string }
interface WorkerRow { worker: string; incarnation: number; pid: number; backend: string; instruction_set: string; state: string; task: string | null; labels?: string[] }
interface LogLine { id: number; task: string; attempt: number; worker: string; line: number; at_ms: number; text: string }
interface Curve { total: number; x: number[]; mean: (number | null)[]; min?: (number | null)[]; max?: (number | null)[]; count?: number[]; nan?: number[]; key?: string }
interface Checkpoint { stage: string; step: number; at_ms: number; digest: string; draws: boolean }
interface Who { name: string; project?: string; scopes: string[]; until_ms?: number; now_ms: number; store: string; version: string; streams: boolean }
interface Model { model: string; metric: string | null; mode: string | null; versions: number; best: number | null; aliases: Record<string, number> }
interface Version { model: string; version: number; artifact: string; metrics: Record<string, number>; source: Record<string, unknown> | null; created_ms: number; aliases: string[] }
interface GateResult { gate: string; value: number | null; bound: number | null; holds: boolean; message: string }
interface Promotion { id: number; at_ms: number; model: string; alias: string; action: string; from: number | null; to: number; actor: string; reason: string; gates: GateResult[] }
interface LineageNode { digest: string; kind: string | null; run: string | null; stage: string | null; key: string | null; bytes: number | null; inputs: Record<string, string>; depth: number }
interface AuditEntry { at_ms: number; until_ms?: number; who: string; call: string; object?: string; from: string; status: number; count?: number }

/** What the frame gives to views. */
interface Context {
  /** Draws what is known again. */
  draw(): void;
  /** Asks the server at once. */
  refresh(): Promise<void>;
  /** Says what came of something, for eyes and screen readers. */
  say(text: string): void;
}
interface View {
  title: string;
  /** Milliseconds between two questions. */
  every: number;
  load(signal: AbortSignal): Promise<void>;
  render(): unknown;
  /** True if an event changes the view, so that the server is asked at once. */
  hears?(row: HistoryRow): boolean;
  close?(): void;
}
