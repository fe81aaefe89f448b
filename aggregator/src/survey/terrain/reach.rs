//! How far the heights of a grid reach: where they are, and between them.
//!
//! What it knows nothing about: what heights mean.

/// For each cell of a grid, row by row, whether heights reach it.
pub(super) struct Reach {
    width: usize,
    cells: Vec<bool>,
}

impl Reach {
    /// Heights reach a cell that has one, and a cell between two of one row or one column that are at most `apart` cells from
    /// each other. Without a height, a cell is NaN.
    pub(super) fn of(heights: &[f32], [width, height]: [usize; 2], apart: usize) -> Self {
        let mut cells: Vec<bool> = heights.iter().map(|height| !height.is_nan()).collect();
        let known = cells.clone();
        for y in 0..height {
            close((0..width).map(|x| y * width + x), &known, &mut cells, apart);
        }
        for x in 0..width {
            close((0..height).map(|y| y * width + x), &known, &mut cells, apart);
        }
        Self { width, cells }
    }

    pub(super) fn has(&self, [column, row]: [usize; 2]) -> bool {
        column < self.width && self.cells.get(row * self.width + column).is_some_and(|cell| *cell)
    }
}

/// Fills the gaps between known cells of a line.
fn close(line: impl Iterator<Item = usize> + Clone, known: &[bool], cells: &mut [bool], apart: usize) {
    let places: Vec<usize> = line.clone().enumerate().filter(|(_, i)| known[*i]).map(|(at, _)| at).collect();
    let line: Vec<usize> = line.collect();
    for pair in places.windows(2).filter(|pair| pair[1] - pair[0] <= apart) {
        line[pair[0]..pair[1]].iter().for_each(|cell| cells[*cell] = true);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_closed_and_edges_are_not() {
        let rows = ["....#.", "#..#..", "......", "#....."];
        let heights: Vec<f32> =
            rows.concat().chars().map(|c| if c == '#' { 1.0 } else { f32::NAN }).collect();
        let reach = |apart: usize| {
            let reach = Reach::of(&heights, [6, 4], apart);
            let row =
                |y: usize| (0..6).map(|x| if reach.has([x, y]) { '#' } else { '.' }).collect::<String>();
            [0, 1, 2, 3].map(row)
        };
        assert_eq!(reach(3), ["....#.", "####..", "#.....", "#....."]);
        assert_eq!(reach(1), rows);
        assert!(!Reach::of(&heights, [6, 4], 3).has([6, 0]), "beyond the grid");
    }
}
