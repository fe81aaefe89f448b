//! The device that trains or merges: the processor or a graphics card.

use cosurf_engine::DeviceChoice;

use super::Finding;

/// Checks that the chosen device can be opened.
pub fn check(choice: DeviceChoice) -> Finding {
    match choice.open() {
        Ok(device) if device.is_gpu() => Finding::ok("compute", device.to_string()),
        Ok(_) if choice == DeviceChoice::Auto => {
            Finding::ok("compute", "the processor; no graphics card was found")
        }
        Ok(_) => Finding::ok("compute", "the processor"),
        Err(error) => Finding::failed("compute", format_args!("{choice}: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_graphics_card_that_is_not_there_must_be_mended() {
        assert!(!check(DeviceChoice::Cpu).is_fault() && !check(DeviceChoice::Auto).is_fault());
        assert!(check(DeviceChoice::Gpu(Some(99))).is_fault());
    }
}
