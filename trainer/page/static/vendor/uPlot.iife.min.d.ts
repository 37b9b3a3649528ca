/** What the page uses of uPlot, which a script of the document makes global. */
declare class uPlot {
  constructor(options: object, data: (number | null)[][], element: HTMLElement);
  static sync(key: string): { key: string };
  static join(tables: (number | null)[][][]): (number | null)[][];
  setData(data: (number | null)[][]): void;
  setSize(size: { width: number; height: number }): void;
  destroy(): void;
}
