//! Campaign
