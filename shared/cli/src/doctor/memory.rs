//! Memory: what a program may take, compared with what there is.

use cosurf_contract::usage;
use cosurf_scene::bytes::format_bytes;

use super::Finding;

/// Checks that a program which takes at most `needed_bytes` fits. `setting` names what lowers the need.
pub fn check(needed_bytes: u64, setting: &str) -> Finding {
    found(needed_bytes, setting, usage::limit_bytes(), usage::available_bytes())
}

fn found(
    needed_bytes: u64,
    setting: &str,
    limit_bytes: Option<u64>,
    available_bytes: Option<u64>,
) -> Finding {
    let needed = format!("takes at most {}", format_bytes(needed_bytes));
    // Buffers of the system count too: the rest of an eighth is for them.
    let exceeded = limit_bytes.filter(|limit| needed_bytes > limit / 8 * 7);
    if let Some(limit) = exceeded {
        let found = format!("{needed}, but the limit of this group of processes is {}", format_bytes(limit));
        let remedy = format!("lower {setting}, or raise MemoryMax of the unit or the container's limit");
        return Finding::mend("memory", found, remedy);
    }
    match available_bytes {
        Some(available) if needed_bytes > available => {
            let found = format!("{needed}, and {} are free now", format_bytes(available));
            Finding::note("memory", found, format!("lower {setting}, or stop other programs"))
        }
        Some(available) => Finding::ok("memory", format!("{needed}; {} are free", format_bytes(available))),
        None => Finding::ok("memory", needed),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_of_the_group_must_hold_and_other_programs_may_end() {
        let limit = Some(1 << 30);
        assert!(!found(7 << 27, "`memory`", limit, Some(1 << 30)).is_fault());
        let finding = found((7 << 27) + 1, "`memory`", limit, None);
        assert!(finding.is_fault() && finding.to_string().contains("lower `memory`"), "{finding}");
        let finding = found(2 << 30, "`memory`", None, Some(1 << 30));
        assert!(!finding.is_fault() && finding.to_string().starts_with("note"), "{finding}");
    }
}
