/** What the page uses of uPlot. */
export default class uPlot {
  constructor(options: object, data: (number | null)[][], element: HTMLElement);
  static sync(key: string): { key: string };
  static join(tables: (number | null)[][][]): (number | null)[][];
  setData(data: (number | null)[][]): void;
  setSize(size: { width: number; height: number }): void;
  destroy(): void;
}
