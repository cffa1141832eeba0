// What happened to the rays of a picture.

export interface Audit {
  rays: number;
  /** Of one ray at most. */
  mostSteps: number;
  meanSteps: number;
  /** Rays for which no face of a cell was found to leave through; they went on through the nearest one. */
  lost: number;
  /** Rays that ended at the bound of steps. */
  bounded: number;
}

/** No ray takes more steps; what comes behind them is not seen. */
export const STEP_BOUND = 16384;

/** @param records Of each ray, as walk.wgsl leaves them. */
export function auditOf(records: Uint32Array): Audit {
  const audit: Audit = { rays: records.length, mostSteps: 0, meanSteps: 0, lost: 0, bounded: 0 };
  for (const record of records) {
    const steps = record & 0xffffff;
    audit.mostSteps = Math.max(audit.mostSteps, steps);
    audit.meanSteps += steps / records.length;
    audit.lost += (record >> 24) & 1;
    audit.bounded += (record >> 25) & 1;
  }
  return audit;
}
