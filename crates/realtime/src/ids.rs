//! Random identifiers, which can't be guessed.

use palpate_refusal::{Reason, Refusal, Result};

/// Returns 128 random bits as 32 lowercase hexadecimal digits.
///
/// # Errors
/// Refuses if the system has no random numbers ([`Reason::TooMany`]).
pub fn random_id() -> Result<String> {
    Ok(format!("{:032x}", random_bits()?))
}

/// Returns 128 random bits from the system, fit for secrets.
///
/// # Errors
/// Refuses if the system has no random numbers ([`Reason::TooMany`]).
pub fn random_bits() -> Result<u128> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes)
        .map_err(|e| Refusal::new(Reason::TooMany, "", format!("the system has no random numbers: {e}")))?;
    Ok(u128::from_le_bytes(bytes))
}
